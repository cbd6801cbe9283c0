"""The step that films: ``stage=render``."""

from __future__ import annotations

import logging

from hydra.utils import instantiate

from devrf.artifacts.camera_paths import focus_distance, orbit, spiral
from devrf.artifacts.film import FilmSettings, pictures, write_video
from devrf.rendering.player import Player
from devrf.run.context import RunContext
from devrf.stages.held_out import background_value

log = logging.getLogger(__name__)


def render(run: RunContext) -> None:
    """Film the held-out view over time, and an orbit (or a spiral) while time runs."""
    stored, scene = run.load("deformation", "canonical"), run.scene
    film: FilmSettings = instantiate(run.config.video)
    player = Player(stored.model.to(run.device))
    held_out = scene.dynamic.test.cameras[[0] * film.frames]
    captured = scene.static.train.cameras
    paths = {"held_out": held_out}
    if scene.kind == "forward":
        paths["spiral"] = spiral(captured, focus_distance(player, captured), film)
    else:
        paths["orbit"] = orbit(captured, player.model.canonical.box, film)
    for name, cameras in paths.items():
        path = run.folder / "videos" / f"{name}.mp4"
        shown = pictures(player, cameras, background_value(scene.background))
        write_video(path, shown, film.fps)
        log.info("video written to %s", path)
        for tracker in run.trackers:
            tracker.show_video(f"videos/{name}", path)

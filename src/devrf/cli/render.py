"""``stage=render``: videos."""

from __future__ import annotations

import logging

from hydra.utils import instantiate

from devrf.artifacts.camera_paths import focus_distance, orbit, spiral
from devrf.artifacts.film import SMALLEST, WATCHABLE, FilmSettings, pictures, write_video
from devrf.cli.context import RunContext
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer

log = logging.getLogger(__name__)


def render(run: RunContext) -> None:
    """Film the held-out view over time, and an orbit (or a spiral) while time runs."""
    stored, scene = run.load(), run.scene
    film: FilmSettings = instantiate(run.config.video)
    renderer = Renderer(stored.model.to(run.device), half=film.half)
    held_out = film.sized(scene.dynamic.test.cameras[[0] * film.frames])
    captured = film.sized(scene.static.train.cameras)
    paths = {"held_out": held_out}
    if scene.kind == "forward":
        paths["spiral"] = spiral(captured, focus_distance(renderer, captured), film)
    else:
        paths["orbit"] = orbit(captured, renderer.model.box, film)
    for name, cameras in paths.items():
        path = run.folder / "videos" / f"{name}.mp4"
        shown = pictures(renderer, cameras, background_value(scene.background))
        write_video(path, shown, film.fps, least=WATCHABLE if film.height is None else SMALLEST)
        log.info("video written to %s", path)
        for tracker in run.trackers:
            tracker.show_video(f"videos/{name}", path)

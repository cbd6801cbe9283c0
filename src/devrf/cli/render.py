"""``stage=render`` and ``stage=still``: videos and images."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from hydra.utils import instantiate
from torch import Tensor

from devrf.artifacts.camera_paths import focus_distance, orbit, spiral
from devrf.artifacts.film import SMALLEST, WATCHABLE, FilmSettings, pictures, write_video
from devrf.artifacts.held_out_film import beside_truth
from devrf.artifacts.images import write_image
from devrf.artifacts.still import StillSettings, still
from devrf.cli.context import RunContext
from devrf.evaluation.held_out import background_value
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer

log = logging.getLogger(__name__)


def render(run: RunContext) -> None:
    """Film the held-out view over time, and an orbit (or a spiral) while time runs.

    Of a scene at rest the held-out views are filmed one after the other, beside the truth.
    """
    stored, scene = run.load(), run.scene
    film: FilmSettings = instantiate(run.config.video)
    renderer = Renderer(stored.model.to(run.device), half=film.half)
    captured = film.sized(scene.static.train.cameras)
    background = background_value(scene.background)
    paths: dict[str, Cameras] = {}
    films: dict[str, Iterator[Tensor]] = {}
    if scene.moves:
        paths["held_out"] = film.sized(scene.dynamic.test.cameras[[0] * film.frames])
    else:
        films["held_out"] = beside_truth(renderer, scene.static.test, scene.background, film)
    if scene.kind == "forward":
        paths["spiral"] = spiral(captured, focus_distance(renderer, captured), film)
    else:
        paths["orbit"] = orbit(captured, renderer.model.box, film)
    for name, cameras in paths.items():
        films[name] = pictures(renderer, cameras, background)
    for name, shown in films.items():
        path = run.folder / "videos" / f"{name}.mp4"
        write_video(path, shown, film.fps, least=WATCHABLE if film.height is None else SMALLEST)
        log.info("video written to %s", path)
        for tracker in run.trackers:
            tracker.show_video(f"videos/{name}", path)


def picture(run: RunContext) -> None:
    """Render the scene from one camera at one time."""
    settings: StillSettings = instantiate(run.config.still)
    stored, camera = run.load(), settings.camera(run.scene)
    renderer = Renderer(stored.model.to(run.device), half=settings.half)
    color, depth = still(renderer, camera, settings.time, background_value(run.scene.background))
    for name, image in (("still", color), ("still_depth", depth)):
        path = run.folder / "images" / f"{name}.png"
        write_image(path, image)
        log.info("picture written to %s", path)

"""``stage=render``: videos."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator

from hydra.utils import instantiate
from torch import Tensor

from devrf.artifacts.camera_paths import focus_distance, held_out_images, orbit, spiral
from devrf.artifacts.film import FilmSettings, held_out_pictures, orbit_pictures, write_video
from devrf.artifacts.still import still
from devrf.cli.context import RunContext
from devrf.evaluation.held_out import background_value
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views
from devrf.system.progress import followed

log = logging.getLogger(__name__)


def render(run: RunContext) -> None:
    """Film the held-out views over time, and an orbit (or a spiral) while time runs."""
    stored, scene = run.load(), run.scene
    film: FilmSettings = instantiate(run.config.video)
    renderer = Renderer(stored.model.to_view(run.device), half=film.half)
    views = (scene.dynamic if scene.moves else scene.static).test
    film, captured = _within_limit(film, renderer, views), film.sized(scene.static.train.cameras)
    images = held_out_images(views, film.frames)
    _write(
        run, film, "held_out", held_out_pictures(renderer, views, images, film, scene.background)
    )
    forward = scene.kind == "forward"
    if forward:
        path = spiral(captured, focus_distance(renderer, scene.static.train.cameras), film)
    else:
        path = orbit(captured, renderer.model.box, film)
    shown = orbit_pictures(renderer, path, background_value(scene.background))
    _write(run, film, "spiral" if forward else "orbit", shown)


def _within_limit(film: FilmSettings, renderer: Renderer, views: Views) -> FilmSettings:
    """The settings, with fewer frames where ``video.max_seconds`` would not suffice."""
    if film.max_seconds is None:
        return film
    cameras = film.sized(views.cameras[[0]])
    began = time.perf_counter()
    still(renderer, cameras, 0.5, 1.0)
    seconds = time.perf_counter() - began
    fewer = film.within_limit(seconds)
    if fewer.frames < film.frames:
        log.warning(
            "videos have %d frames, not %d: rendering one takes %.1f s; video.max_seconds=null "
            "renders all, a lower video.height is faster",
            fewer.frames,
            film.frames,
            seconds,
        )
    return fewer


def _write(run: RunContext, film: FilmSettings, name: str, images: Iterator[Tensor]) -> None:
    path = run.folder / "videos" / f"{name}.mp4"
    write_video(path, followed(images, film.frames, f"{name}.mp4"), film.fps)
    log.info("video written to %s", path)
    for tracker in run.trackers:
        tracker.show_video(f"videos/{name}", path)

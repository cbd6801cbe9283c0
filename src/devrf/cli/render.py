"""``stage=render``: videos."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from hydra.utils import instantiate
from torch import Tensor

from devrf.apps.keyframes import cameras_of, read_path
from devrf.apps.still import still
from devrf.apps.video import (
    VideoSettings,
    bullet_time,
    focus_distance,
    held_out_images,
    held_out_pictures,
    orbit,
    orbit_pictures,
    spiral,
    time_freeze,
    write_video,
)
from devrf.cli.context import RunContext
from devrf.evaluation.held_out import background_value
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views
from devrf.system.progress import followed

log = logging.getLogger(__name__)

# What video.path may be beside a file.
PRESETS = {"bullet_time": bullet_time, "time_freeze": time_freeze}


def render(run: RunContext) -> None:
    """Film the held-out views over time, and an orbit (or a spiral) while time runs.

    With ``video.path`` that path alone is filmed.
    """
    film: VideoSettings = instantiate(run.config.video)
    path = None if film.path in (None, *PRESETS) else read_path(Path(str(film.path)))
    stored, scene = run.load(), run.scene
    renderer = Renderer(stored.model.to_view(run.device), half=film.half)
    behind = background_value(scene.background)
    views = (scene.dynamic if scene.moves else scene.static).test
    if path is not None:
        film = replace(film, frames=path.frames, fps=path.fps)
    film, captured = _within_limit(film, renderer, views), film.sized(scene.static.train.cameras)
    forward = scene.kind == "forward"

    def ring(settings: VideoSettings) -> Cameras:
        if forward:
            focus = focus_distance(renderer, scene.static.train.cameras)
            return spiral(captured, focus, settings)
        return orbit(captured, renderer.model.box, settings)

    if path is not None:
        keyframes = path.sampled(film.frames)
        cameras = cameras_of(keyframes, path.aspect, captured.height)
        shown = orbit_pictures(renderer, cameras, behind, [one.time for one in keyframes])
        _write(run, film, Path(str(film.path)).stem, shown)
    elif film.path is not None:
        cameras, times = PRESETS[film.path](ring, film.time, film)
        _write(run, film, film.path, orbit_pictures(renderer, cameras, behind, times))
    else:
        images = held_out_images(views, film.frames)
        shown = held_out_pictures(renderer, views, images, film, scene.background)
        _write(run, film, "held_out", shown)
        shown = orbit_pictures(renderer, ring(film), behind)
        _write(run, film, "spiral" if forward else "orbit", shown)


def check_path(film: VideoSettings) -> None:
    """Check that ``video.path`` can be filmed, long before it is.

    Raises:
        DevrfError: it cannot.
    """
    if film.path not in (None, *PRESETS):
        _ = read_path(Path(str(film.path))).frames


def _within_limit(film: VideoSettings, renderer: Renderer, views: Views) -> VideoSettings:
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


def _write(run: RunContext, film: VideoSettings, name: str, images: Iterator[Tensor]) -> None:
    path = run.folder / "videos" / f"{name}.mp4"
    write_video(path, followed(images, film.frames, f"{name}.mp4"), film.fps)
    log.info("video written to %s", path)
    for tracker in run.trackers:
        tracker.show_video(f"videos/{name}", path)

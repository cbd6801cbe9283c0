"""The videos of a learned scene that ``stage=render`` writes."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from devrf.apps.keyframes import CameraPath, cameras_of, read_path
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
)
from devrf.evaluation.held_out import background_value
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, Views

log = logging.getLogger(__name__)

# What video.path may be beside a file.
PRESETS = {"bullet_time": bullet_time, "time_freeze": time_freeze}


class Video(NamedTuple):
    """Pictures (H, W, 3) in [0, 1] that are rendered as they are asked for."""

    name: str
    fps: float
    frames: int
    pictures: Iterator[Tensor]


def camera_path(settings: VideoSettings) -> CameraPath | None:
    """The keyframes of the file ``video.path``, if it is one.

    Raises:
        DevrfError: it holds no camera path, or one of too many frames.
    """
    if settings.path is None or settings.path in PRESETS:
        return None
    path = read_path(Path(settings.path))
    _ = path.frames
    return path


def videos(renderer: Renderer, scene: Scene, settings: VideoSettings) -> Iterator[Video]:
    """The held-out views over time, and an orbit (or a spiral) while time runs.

    With ``video.path`` there is that path alone.
    """
    behind, captured = background_value(scene.background), scene.static.train.cameras
    views = (scene.dynamic if scene.moves else scene.static).test
    path = camera_path(settings)
    if path is not None:
        settings = replace(settings, frames=path.frames, fps=path.fps)
    settings, sized = _within_limit(settings, renderer, views), settings.sized(captured)

    def ring(of: VideoSettings) -> Cameras:
        if scene.kind == "forward":
            return spiral(sized, focus_distance(renderer, captured), of)
        return orbit(sized, renderer.model.box, of)

    def video(name: str, pictures: Iterator[Tensor]) -> Video:
        return Video(name, settings.fps, settings.frames, pictures)

    if path is not None:
        keyframes = path.sampled(settings.frames)
        cameras = cameras_of(keyframes, path.aspect, sized.height)
        times = [frame.time for frame in keyframes]
        yield video(Path(str(settings.path)).stem, orbit_pictures(renderer, cameras, behind, times))
    elif settings.path is not None:
        cameras, times = PRESETS[settings.path](ring, settings.time, settings)
        yield video(settings.path, orbit_pictures(renderer, cameras, behind, times))
    else:
        images = held_out_images(views, settings.frames)
        shown = held_out_pictures(renderer, views, images, settings, scene.background)
        yield video("held_out", shown)
        name = "spiral" if scene.kind == "forward" else "orbit"
        yield video(name, orbit_pictures(renderer, ring(settings), behind))


def _within_limit(settings: VideoSettings, renderer: Renderer, views: Views) -> VideoSettings:
    """The settings, with fewer frames where ``video.max_seconds`` would not suffice."""
    if settings.max_seconds is None:
        return settings
    cameras = settings.sized(views.cameras[[0]])
    began = time.perf_counter()
    still(renderer, cameras, 0.5, 1.0)
    seconds = time.perf_counter() - began
    fewer = settings.within_limit(seconds)
    if fewer.frames < settings.frames:
        log.warning(
            "videos have %d frames, not %d: rendering one takes %.1f s; video.max_seconds=null "
            "renders all, a lower video.height is faster",
            *(fewer.frames, settings.frames, seconds),
        )
    return fewer

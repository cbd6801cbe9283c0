"""The videos of a learned scene that ``stage=render`` writes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from devrf.apps.camera_paths import (
    CAMERA_PATHS,
    NAMES,
    PRESETS,
    SWING,
    default_path,
    focus_distance,
    looked_at,
    swing,
)
from devrf.apps.keyframes import CameraPath, cameras_of, read_path
from devrf.apps.still import sized, still
from devrf.apps.video import (
    MIN_HEIGHT,
    VideoSettings,
    held_out_images,
    held_out_pictures,
    held_out_times,
    path_pictures,
)
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.offset import NO_OFFSET, Offset
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Views, background_value

log = logging.getLogger(__name__)


class Video(NamedTuple):
    """Pictures (H, W, 3), uint8, that are rendered as they are asked for."""

    name: str
    fps: float
    frames: int
    pictures: Iterator[Tensor]


def camera_path(settings: VideoSettings, offset: Offset = NO_OFFSET) -> CameraPath | None:
    """The keyframes of the file ``video.path``, if it is one, without the scene's ``offset``.

    Raises:
        DevrfError: it holds no camera path, or one of too many frames.
    """
    if settings.path is None or settings.path in NAMES:
        return None
    path = read_path(Path(settings.path), offset)
    try:
        _ = path.frames
    except DevrfError as error:
        raise DevrfError(f"{settings.path}: {error}") from None
    return path


def videos(
    renderer: Renderer, viewpoints: Viewpoints, settings: VideoSettings, held_out: Views | None
) -> Iterator[Video]:
    """The ``held_out`` views over time, if any, and the scene from a moving camera meanwhile.

    If ``video.path`` is given there is that path alone.
    """
    behind = background_value(viewpoints.background)
    static = viewpoints.static
    if settings.path == SWING and not viewpoints.followed:
        expected = "another way, since it was not one moving camera that saw the scene move"
        raise DevrfError(f"video.path: expected {expected}, not {SWING}")
    path = camera_path(settings, viewpoints.offset)
    if path is not None:
        settings = replace(settings, frames=path.frames, fps=path.fps)
    settings = _within_limit(settings, renderer, sized(viewpoints.held_out, settings.height))
    captured = sized(static, settings.height)
    space = renderer.model.space

    def filmed(name: str) -> Callable[[VideoSettings], Cameras]:
        target = looked_at(renderer.model, static, lambda: focus_distance(renderer, static))
        return lambda of: CAMERA_PATHS[name](captured, target, of)

    def video(name: str, pictures: Iterator[Tensor]) -> Video:
        return Video(name, settings.fps, settings.frames, pictures)

    if path is not None:
        keyframes = path.sampled(settings.frames)
        cameras = cameras_of(keyframes, path.aspect, captured.height)
        times = [frame.time for frame in keyframes]
        yield video(Path(str(settings.path)).stem, path_pictures(renderer, cameras, behind, times))
        return
    if settings.path in PRESETS:
        ring = filmed(default_path(space, closed=True))
        cameras, times = PRESETS[settings.path](ring, settings.time, settings)
        yield video(settings.path, path_pictures(renderer, cameras, behind, times))
        return
    if held_out is not None:
        images = held_out_images(held_out, settings.frames)
        background = viewpoints.background
        pictures = held_out_pictures(
            partial(still, renderer),
            renderer.model.moves,
            held_out,
            images,
            held_out_times(held_out, images),
            settings,
            background,
        )
        yield video("held_out", pictures)
    name = settings.path or default_path(space)
    if name == SWING or (viewpoints.followed and not settings.path and name != "orbit"):
        followed = sized(viewpoints.dynamic, settings.height)
        cameras, times = swing(followed, viewpoints.followed, settings)
        yield video(SWING, path_pictures(renderer, cameras, behind, times))
        return
    yield video(name, path_pictures(renderer, filmed(name)(settings), behind))


def _within_limit(settings: VideoSettings, renderer: Renderer, cameras: Cameras) -> VideoSettings:
    """The settings with which each video is rendered in ``video.max_seconds``.

    One picture of the captured ``cameras``, of the video's size, says how long they take.
    """
    if settings.max_seconds is None:
        return settings
    still(renderer, cameras.of_height(MIN_HEIGHT), 0.5, 1.0)  # a warm-up, which is not timed
    began = time.perf_counter()
    still(renderer, cameras, 0.5, 1.0)
    within = settings.within_limit(time.perf_counter() - began, cameras.height)
    if within != settings:
        log.info(
            "videos have %d frames of %d rows, not %d of %d, which would take longer than "
            "video.max_seconds=%g; null renders them",
            within.frames,
            within.height,
            settings.frames,
            cameras.height,
            settings.max_seconds,
        )
    return within

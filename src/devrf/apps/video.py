"""Videos of a learned scene: their settings and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Annotated, ClassVar

import torch
from annotated_types import Ge, Le
from pydantic.dataclasses import dataclass
from torch import Tensor

from devrf.apps.still import DEPTH, MAX_ROWS, READABLE, still
from devrf.evaluation.held_out import truth_image
from devrf.geometry.cameras import Cameras
from devrf.pictures.images import centred, image_grid, scaled
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Background, Views, background_value
from devrf.system.options import Options, Positive, Share

# Cameras, a time in [0, 1], a grey level behind, and the number of a camera → colour and depth as
# colours (H, W, 3) in [0, 1] of what that camera sees, in the size of its image.
Shown = Callable[[Cameras, float, float, int], tuple[Tensor, Tensor]]

# More frames than this are a mistake: an hour at 25 a second.
MAX_FRAMES = 90_000
# Frames a second that FFmpeg takes.
Rate = Annotated[float, Ge(0.01), Le(1000)]
# H.264 has blocks of so many pixels.
MIN_HEIGHT = 16
# To render within max_seconds, images get lower, down to LOW rows; then frames get fewer.
LOW = 160
MIN_FRAMES = 24


@dataclass(frozen=True)
class VideoSettings(Options):
    """Settings of ``stage=render``; ``conf/video/default.yaml`` says what each does."""

    key: ClassVar[str] = "video"

    frames: Annotated[int, Ge(1), Le(MAX_FRAMES)] = 120
    fps: Rate = 24
    orbit_turns: Annotated[float, Ge(-1000), Le(1000)] = 1.0
    orbit_elevation: Annotated[float, Ge(-90), Le(90)] | None = None
    height: Annotated[int, Ge(MIN_HEIGHT), Le(MAX_ROWS)] | None = None
    max_seconds: Positive | None = None
    path: str | None = None
    time: Share = 0.5
    motion_masks: bool = False

    def within_limit(self, seconds: float, height: int) -> VideoSettings:
        """The settings for images of ``height`` rows that take ``seconds`` each.

        Images are made lower if need be; if that does not suffice, there are fewer.
        """
        share = 1.0 if self.max_seconds is None else self.max_seconds / (self.frames * seconds)
        if share >= 1:
            return self
        lower = max(int(height * math.sqrt(share)), min(height, LOW))
        frames = int(self.frames * min(share * (height / lower) ** 2, 1))
        return replace(self, height=lower, frames=max(frames, min(self.frames, MIN_FRAMES)))


def path_pictures(
    renderer: Renderer,
    cameras: Cameras,
    background: float,
    times: Sequence[float] | None = None,
) -> Iterator[Tensor]:
    """Colour beside depth (H', W', 3) from each of N cameras.

    ``background`` is a grey level. ``times`` are N times in [0, 1] of cameras that may be
    anywhere; None: time runs from 0 to 1.
    """
    for index in range(len(cameras)):
        time = index / max(len(cameras) - 1, 1) if times is None else times[index]
        crop = None if times is None else renderer.reach(cameras.positions[index])
        color, depth = still(renderer, cameras, time, background, index, crop)
        heading = f"time {time:.2f}" if renderer.model.moves else "rendered"
        yield image_grid([[color, depth]], [heading, DEPTH])


def held_out_times(views: Views, images: Sequence[int]) -> list[float]:
    """The time of each frame: from 0 to 1, but an image with a pose of its own has its own."""
    if views.by_moving_camera and len(views) > 1:
        return views.times[images].tolist()
    return torch.linspace(0, 1, len(images)).tolist()


def held_out_pictures(
    shown: Shown,
    moves: bool,
    views: Views,
    images: Sequence[int],
    times: Sequence[float],
    settings: VideoSettings,
    background: Background,
) -> Iterator[Tensor]:
    """Truth, what is ``shown`` of it, and depth (H', W', 3) side by side.

    Images of several sizes are at one scale, in tiles for the widest and the highest. Headings say
    times if the scene ``moves``. ``images`` are those of the ``views`` to show, one a frame
    (:func:`held_out_images`), at ``times`` (:func:`held_out_times`).
    """
    rows = max(views.height, READABLE) if settings.height is None else settings.height
    cameras = views.cameras.of_height(rows)
    behind = background_value(background)
    larger = ", enlarged" if cameras.height > views.height else ""
    shots = zip(images, times, strict=True)
    for (image, time), frames in groupby(shots):
        color, depth = shown(cameras, time, behind, image)
        # Resized from its own size, not rendered: it is the truth to compare with.
        truth = truth_image(views, image, background)
        size = f"({truth.shape[1]}x{truth.shape[0]}{larger})"
        truth = scaled(truth, color.shape[0], color.shape[1])
        at = ""
        at_time = ""
        if moves:
            at = f" at {float(views.times[image]):.2f}"
            at_time = f" at time {time:.2f}"
        headings = [f"truth{at} {size}", f"rendered{at_time}", DEPTH]
        tiles = [centred(tile, cameras.height, cameras.width) for tile in (truth, color, depth)]
        picture = image_grid([tiles], headings)
        yield from (picture for _ in frames)


def held_out_images(views: Views, frames: int) -> list[int]:
    """The held-out image for each of ``frames`` times, evenly spread over [0, 1].

    If cameras are fixed, all are images of the first one. Images at rest follow one another.
    """
    first = (views.view == views.view[0]).nonzero()[:, 0]
    images = first if len(first) > 1 else torch.arange(len(views))
    times = views.times[images]
    if bool((times == times[0]).all()):
        times = torch.linspace(0, 1, len(images))
    wanted = torch.linspace(0, 1, frames)
    nearest = (times[None] - wanted[:, None]).abs().argmin(dim=1)
    return [int(image) for image in images[nearest]]

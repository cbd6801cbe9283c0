"""Videos of a learned scene, colour beside depth, while time runs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import imageio
import numpy as np
import torch
from torch import Tensor

from devrf.artifacts.colors import to_bytes
from devrf.artifacts.images import enlarged
from devrf.artifacts.still import still
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer
from devrf.system.files import atomic_write

# Smaller images are enlarged to this height: a video of 100 pixels is too small to watch.
WATCHABLE = 240
# Upper bound of the bytes of a pixel in a video: measured on images of 200 pixels and less.
PIXEL = 0.2
# H.264 has blocks of so many pixels.
SMALLEST = 16


@dataclass(frozen=True)
class FilmSettings:
    """The videos that ``stage=render`` writes.

    Attributes:
        frames: images of each video, evenly spread over [0, 1]: times between the captured
            frames are rendered like any other.
        fps: images a second.
        orbit_turns: how often the orbit goes round while time runs once.
        orbit_elevation: degrees above the horizon.
        height: of the images in pixels; None for the captured images' height, with small
            images enlarged.
        half: whether the colour network works in half precision, on a CUDA device only.
    """

    frames: int = 60
    fps: int = 20
    orbit_turns: float = 1.0
    orbit_elevation: float = 25.0
    height: int | None = None
    half: bool = False

    def __post_init__(self) -> None:
        if self.height is not None and self.height < SMALLEST:
            raise DevrfError(f"video.height: expected at least {SMALLEST}, not {self.height}")

    def sized(self, cameras: Cameras) -> Cameras:
        """Captured cameras with images of the video's size."""
        return cameras if self.height is None else cameras.of_height(self.height)


def pictures(renderer: Renderer, cameras: Cameras, background: float) -> Iterator[Tensor]:
    """Colour beside depth (H, 2W, 3) from each of N cameras, while time runs from 0 to 1."""
    for index in range(len(cameras)):
        time = index / max(len(cameras) - 1, 1)
        yield torch.cat(still(renderer, cameras, time, background, index), dim=1)


def write_video(path: Path, images: Iterator[Tensor], fps: int, *, least: int = WATCHABLE) -> None:
    """Write images (H, W, 3) in [0, 1] of one size as an mp4 (H.264), ``fps`` a second.

    Images less than ``least`` pixels high are enlarged by a whole factor.
    """
    with atomic_write(path) as partial:
        writer = imageio.get_writer(
            partial, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2
        )
        # As a context manager of its own it would leave ffmpeg running, and writing, on an error.
        with closing(writer):
            for image in images:
                shown = to_bytes(enlarged(image, height=least)).numpy()
                odd = [(0, side % 2) for side in shown.shape[:2]]  # H.264 needs even sides
                writer.append_data(np.pad(shown, [*odd, (0, 0)], mode="edge"))


def film_bytes(film: FilmSettings, cameras: Cameras) -> int:
    """Upper estimate of a video's size in bytes, colour beside depth, for the captured cameras."""
    sized = film.sized(cameras)
    enlarged = max(1, math.ceil(WATCHABLE / sized.height)) if film.height is None else 1
    return round(film.frames * 2 * sized.height * sized.width * enlarged**2 * PIXEL)

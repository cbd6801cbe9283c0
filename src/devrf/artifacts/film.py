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

from devrf.artifacts.colors import depth_colors, to_bytes
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.rendering.rendered_image import RenderedImage
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.system.files import atomic_write

# Small pictures are shown enlarged: a video of 100 pixels is too small to watch.
WATCHABLE = 240
# Bytes that a pixel of a video takes, at most: met in scenes of two hundred pixels and less.
PIXEL = 0.2
# H.264 has blocks of so many pixels.
SMALLEST = 16


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed.

    Attributes:
        frames: pictures of each video, evenly spread over [0, 1]: times between the captured
            frames are rendered like any other.
        fps: pictures a second.
        orbit_turns: how often the orbit goes round while time runs once.
        orbit_elevation: degrees above the horizon.
        height: of the pictures in pixels; None for the captured images' height, with small
            pictures shown enlarged.
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
        """Captured cameras with images of the size that is filmed."""
        return cameras if self.height is None else cameras.of_height(self.height)


def pictures(player: Renderer, cameras: Cameras, background: float) -> Iterator[Tensor]:
    """Colour beside depth (H, 2W, 3) from each of N cameras, while time runs from 0 to 1."""
    times = [k / max(len(cameras) - 1, 1) for k in range(len(cameras))]
    seen = player.stream(cameras, times, background)
    for picture, position in zip(seen, cameras.positions, strict=True):
        depth = depth_picture(player.model, picture, position, cameras.height)
        yield torch.cat([picture.color.view(depth.shape).cpu(), depth], dim=1)


def depth_picture(model: Viewable, picture: RenderedImage, position: Tensor, height: int) -> Tensor:
    """How far away things are (H, W, 3), of a whole image that a camera at ``position`` sees."""
    near, far = model.space.depth_range(model.box, model.depth_limits, position)
    depth, opacity = picture.depth.view(height, -1), picture.opacity.view(height, -1)
    return depth_colors(depth.cpu(), opacity.cpu(), near, far)


def write_video(path: Path, images: Iterator[Tensor], fps: int, *, least: int = WATCHABLE) -> None:
    """Write images (H, W, 3) in [0, 1] of one size as an mp4 (H.264).

    Args:
        path: the file.
        images: the pictures.
        fps: pictures a second.
        least: smaller pictures are enlarged by whole pixels to this height or more.
    """
    with atomic_write(path) as partial:
        writer = imageio.get_writer(
            partial, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2
        )
        # As a context manager of its own it would leave ffmpeg running, and writing, on an error.
        with closing(writer):
            for image in images:
                writer.append_data(_enlarged(to_bytes(image).numpy(), least))


def film_bytes(film: FilmSettings, cameras: Cameras) -> int:
    """About how large a video becomes, colour beside depth; rather less.

    Args:
        film: what is filmed.
        cameras: captured cameras with images of the usual size.
    """
    sized = film.sized(cameras)
    enlarged = max(1, math.ceil(WATCHABLE / sized.height)) if film.height is None else 1
    return round(film.frames * 2 * sized.height * sized.width * enlarged**2 * PIXEL)


def _enlarged(image: np.ndarray, least: int) -> np.ndarray:
    """Enlarged by whole pixels to a height or more, with even sides as H.264 needs."""
    factor = max(1, math.ceil(least / image.shape[0]))
    image = image.repeat(factor, axis=0).repeat(factor, axis=1)
    return np.pad(image, [(0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)], mode="edge")

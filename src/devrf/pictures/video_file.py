"""Text in pictures, and pictures as a video file; needs no torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path

import imageio
import matplotlib
import numpy as np
from PIL import ImageFont

from devrf.system.files import atomic_write


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """matplotlib's own font, which has more letters than Pillow's, ``size`` pixels high."""
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


def fitted_font(text: str, size: int, width: int) -> ImageFont.FreeTypeFont:
    """The largest font up to ``size`` in which the text is no wider than ``width`` pixels."""
    needed = font(size).getlength(text)
    return font(max(1, int(size * min(1.0, 0.98 * width / max(needed, 1.0)))))


def write_pictures(path: Path, pictures: Iterator[np.ndarray], fps: float) -> None:
    """Write pictures (H, W, 3) uint8 of one size as an mp4 (H.264), ``fps`` a second.

    A last row or column is repeated where that makes the side even, as H.264 needs it.
    """
    with atomic_write(path) as partial:
        writer = imageio.get_writer(
            partial, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2
        )
        # As a context manager of its own it would leave ffmpeg running, and writing, on an error.
        with closing(writer):
            for picture in pictures:
                odd = [(0, side % 2) for side in picture.shape[:2]]
                writer.append_data(np.pad(picture, [*odd, (0, 0)], mode="edge"))

"""Pictures as a video file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import imageio
import numpy as np

from devrf.system.files import atomic_write


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

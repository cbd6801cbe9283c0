"""Images as files."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
from torch import Tensor

from devrf.artifacts.colors import to_bytes
from devrf.system.files import atomic_write


def write_image(path: Path, image: Tensor) -> None:
    """Write an image (H, W, 3) in [0, 1] as a PNG."""
    with atomic_write(path) as partial:
        iio.imwrite(partial, to_bytes(image).numpy(), extension=".png")

"""Images as files, and their names as labels."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
from torch import Tensor

from devrf.artifacts.colors import to_bytes
from devrf.system.files import atomic_write

# Longest name that fits below a small image, in characters.
LONGEST_NAME = 30


def write_image(path: Path, image: Tensor) -> None:
    """Write an image (H, W, 3) in [0, 1] as a PNG."""
    with atomic_write(path) as partial:
        iio.imwrite(partial, to_bytes(image).numpy(), extension=".png")


def short_name(name: str) -> str:
    """The name of an image's file as a label, without folders; of a long name its end."""
    name = Path(name).name
    return name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}"

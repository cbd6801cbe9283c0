"""Images as files and side by side; and their names as labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from devrf.apps.colors import to_bytes
from devrf.system.files import atomic_write

GAP = 4
# Longest name that fits below a small image, in characters.
LONGEST_NAME = 30


def write_image(path: Path, image: Tensor) -> None:
    """Write an image (H, W, 3) in [0, 1] as a PNG."""
    with atomic_write(path) as partial:
        iio.imwrite(partial, to_bytes(image).numpy(), extension=".png")


def side_by_side(images: Sequence[Tensor]) -> Tensor:
    """Images (H, W, 3) of one height in a row, with ``GAP`` white pixels between them."""
    padded = [torch.nn.functional.pad(image, (0, 0, 0, GAP), value=1.0) for image in images]
    return torch.cat(padded, dim=1)[:, :-GAP]


def short_name(name: str) -> str:
    """The name of an image's file as a label, without folders; of a long name its end."""
    name = Path(name).name
    return name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}"


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` of the positions 0 … count − 1, evenly spread, both ends among them."""
    return [round(k) for k in np.linspace(0, count - 1, min(count, most))]

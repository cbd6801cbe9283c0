"""A pedestal before a painted wall and floor, which fill every image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.sdf import rounded_box
from devrf.scenes.procedural.shape import Material

# The wall is the plane z = WALL, the floor the plane y = FLOOR; world units, y up.
WALL = -4.6
FLOOR = -1.15
# The pedestal's centre, outer half edges and rounding.
_CENTER = (0.0, (FLOOR - 0.72) / 2, -2.6)
_HALF = (0.56, (-0.72 - FLOOR) / 2, 0.44)
_ROUNDING = 0.04

# The number of the part: the wall is 0, the floor 1.
_PEDESTAL = 2

Vector = tuple[float, float, float]
Wave = tuple[Vector, float, Vector]

# Waves of the paint: direction (x, y, z) times angular frequency in radians per world unit, a
# phase, and how much of it goes into red, green and blue. No two wavelengths have a common
# multiple within the picture, so that no place looks like another.
WAVES = (
    ((1.1, 0.7, 0.9), 0.3, (0.7, 0.3, -0.1)),
    ((-1.2, 2.3, -1.7), 1.1, (-0.1, 0.5, 0.4)),
    ((3.9, -1.9, 1.3), 2.0, (0.6, 0.5, 0.7)),
    ((1.3, 4.7, 3.3), 0.7, (0.5, 0.6, 0.3)),
    ((-5.3, -3.9, 4.1), 2.9, (0.6, 0.6, 0.6)),
    ((6.7, 4.1, -2.9), 4.2, (0.5, 0.4, 0.5)),
)
# A weave over the clouds, of wavelengths from 0.11 to 0.27 world units: on the wall five to
# twelve pixels of an image that is 240 pixels wide.
WEAVE = (
    ((23.0, 9.1, 5.3), 0.9, (0.9, 0.5, 0.3)),
    ((-13.7, 29.3, 17.9), 2.2, (0.4, 0.9, 0.6)),
    ((41.3, -7.7, 21.1), 3.7, (0.8, 0.7, 0.8)),
    ((11.9, 37.1, -43.7), 5.1, (0.6, 0.8, 0.9)),
    ((-33.1, -43.3, 31.7), 1.6, (0.7, 0.6, 0.5)),
)
# Paler than what stands before it.
_DARKEST, _LIGHTEST = (0.42, 0.45, 0.52), (0.86, 0.88, 0.90)


@dataclass(frozen=True)
class Backdrop:
    """Wall, floor and pedestal, in that order.

    Attributes:
        weave: whether the paint is fine, for images of about 240 pixels or more; else soft.
    """

    weave: bool = False

    @property
    def parts(self) -> int:
        """How many there are."""
        return 3

    def distances(self, points: Tensor) -> Tensor:
        """Distances (3, M) to wall, floor and pedestal."""
        x, y, z = points.unbind(-1)
        a, b, c = _CENTER
        pedestal = rounded_box(x - a, y - b, z - c, _HALF, _ROUNDING)
        return torch.stack([z - WALL, y - FLOOR, pedestal])

    def color(self, material: Material) -> Tensor:
        """The paint (M, 3): the pedestal stands out from the floor."""
        painted = mural(material.rest, (*WAVES, *WEAVE) if self.weave else WAVES)
        return torch.where((material.part == _PEDESTAL)[:, None], 0.5 * painted, painted)


def mural(points: Tensor, waves: Sequence[Wave]) -> Tensor:
    """Clouds of colour (M, 3), painted in space: the sum of ``waves``, then bounded."""
    wave = points.new_tensor([w for w, _, _ in waves])
    phase = points.new_tensor([p for _, p, _ in waves])
    mixed = (points @ wave.T + phase).cos() @ points.new_tensor([c for _, _, c in waves])
    dark, light = points.new_tensor(_DARKEST), points.new_tensor(_LIGHTEST)
    return torch.lerp(dark, light, torch.sigmoid(1.5 * mixed))

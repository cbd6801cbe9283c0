"""Solid textures: soft-edged patterns painted in a part's own rest coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.shape import Material

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Paint:
    """Two colours mixed by a product of cosines along the part's axes.

    One period makes stripes, two a checkerboard, three a checkerboard in space; a threshold
    above zero shrinks the accent from half of the surface to spots.

    Attributes:
        base: colour where the pattern is low.
        accent: colour where the pattern is high, as at the part's origin.
        periods: length of a full period along x, y, z in world units; 0: constant along it.
        threshold: where, in −1 … 1, base turns into accent.
        sharpness: steepness of the edges. They stay soft, so that an image of about 100 pixels
            does not alias.
    """

    base: Rgb
    accent: Rgb
    periods: tuple[float, float, float] = (0.0, 0.0, 0.0)
    threshold: float = 0.0
    sharpness: float = 6.0


class PaintedParts:
    """The paints of K parts in the parts' own frames.

    Attributes:
        rotation: (K, 3, 3) axes of each part as columns, world ← part, at rest.
        origin: (K, 3) origin of each part at rest, world units.
    """

    def __init__(self, paints: Sequence[Paint], rotation: Tensor, origin: Tensor) -> None:
        """The table of ``paints`` (K of them) in frames (K, 3, 3), (K, 3)."""

        def table(rows: list[tuple[float, ...]]) -> Tensor:
            return torch.tensor(rows, dtype=torch.float64)

        self.rotation = rotation
        self.origin = origin
        self._base = table([p.base for p in paints])
        self._accent = table([p.accent for p in paints])
        # Radians per world unit along the part's axes.
        self._wave = table(
            [tuple(2 * math.pi / q if q else 0.0 for q in p.periods) for p in paints]
        )
        self._edge = table([(p.threshold, p.sharpness) for p in paints])

    def color(self, material: Material) -> Tensor:
        """Albedo (M, 3) of the material."""
        rest, part = material.rest, material.part
        offset = rest - self.origin.to(rest)[part]
        local = torch.einsum("mji,mj->mi", self.rotation.to(rest)[part], offset)
        pattern = (local * self._wave.to(rest)[part]).cos().prod(dim=-1)
        threshold, sharpness = self._edge.to(rest)[part].unbind(-1)
        share = ((pattern - threshold) * sharpness).sigmoid()[:, None]
        return torch.lerp(self._base.to(rest)[part], self._accent.to(rest)[part], share)

    def outline(self, half: Tensor, middle: Tensor) -> Material:
        """A grid of points over the boxes around the parts.

        Args:
            half: (K, 3) half edges along the parts' axes, world units.
            middle: (K, 3) where in its frame each box has its middle.
        """
        steps = torch.linspace(-1, 1, 7)
        cube = torch.cartesian_prod(steps, steps, steps)
        local = cube * half[:, None] + middle[:, None]
        rest = torch.einsum("kij,kmj->kmi", self.rotation.float(), local)
        rest = rest + self.origin.float()[:, None]
        part = torch.arange(len(half)).repeat_interleave(len(cube))
        return Material(rest.reshape(-1, 3), part)

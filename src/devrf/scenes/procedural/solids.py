"""Painted rounded boxes: what the robot and the plush toy are built of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.sdf import rounded_box
from devrf.scenes.procedural.shape import Material
from devrf.scenes.procedural.texture import Paint, PaintedParts

Xyz = tuple[float, float, float]


@dataclass(frozen=True)
class Solid:
    """A rounded box; capsules and balls are boxes with large roundings.

    Attributes:
        center: its centre at rest, world units; the paint's origin too.
        half: outer half edges.
        rounding: radius of its edges.
        paint: its texture.
        link: name of the joint that moves it, "" where none does.
    """

    center: Xyz
    half: Xyz
    rounding: float
    paint: Paint
    link: str = ""


class SolidTable:
    """K solids as tensors.

    Attributes:
        center: (K, 3) float64 centres as the solids give them.
        half: (K, 3) float32 outer half edges.
        painted: their textures, in the world.
    """

    def __init__(self, solids: Sequence[Solid], base: Xyz = (0.0, 0.0, 0.0)) -> None:
        """Tables of ``solids`` whose centres are relative to ``base`` (world units)."""
        self.center = torch.tensor([s.center for s in solids], dtype=torch.float64)
        self.half = torch.tensor([s.half for s in solids])
        self._rounding = torch.tensor([s.rounding for s in solids])[:, None]
        upright = torch.eye(3, dtype=torch.float64).repeat(len(solids), 1, 1)
        origin = self.center + torch.tensor(base, dtype=torch.float64)
        self.painted = PaintedParts([s.paint for s in solids], upright, origin)

    def distances(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Distance (K, M) to each solid of coordinates (K, M) about its centre, along its axes."""
        a, b, c = self.half.to(x).T[..., None]
        return rounded_box(x, y, z, (a, b, c), self._rounding.to(x))

    def outline(self) -> Material:
        """Points around the solids at rest."""
        return self.painted.outline(self.half, torch.zeros_like(self.half))

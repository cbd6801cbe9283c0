"""The plush: a soft toy that squashes, stretches, bends and twists (non-rigid motion)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import Bending, Swing
from devrf.scenes.procedural.solids import Material, Paint, Rgb, Solid, SolidTable, Xyz

# The toy's base: x right, y up, the cameras look along −z from about the origin.
BASE: Xyz = (0.0, -0.72, -2.6)
# Radius of a ball about the base that holds the toy at all times, at speeds of up to 2.
REACH = 1.8


ROSE: Rgb = (0.93, 0.55, 0.62)
CREAM: Rgb = (0.98, 0.91, 0.78)
WINE: Rgb = (0.55, 0.12, 0.26)
INK: Rgb = (0.08, 0.07, 0.12)
SKY: Rgb = (0.30, 0.60, 0.90)
LEMON: Rgb = (0.98, 0.85, 0.25)
MINT: Rgb = (0.35, 0.75, 0.55)

_FUR = Paint(ROSE, CREAM, (0.30, 0.30, 0.30), 0.25)
_SLEEVE = Paint(LEMON, MINT, (0.16, 0, 0))
_SOLE = Paint(WINE, ROSE, (0.22, 0, 0.22), 0.3)
_EAR = Paint(WINE, ROSE, (0, 0.24, 0), 0.1)
_EYE = Paint(INK, INK)


def _pair(center: Xyz, half: Xyz, rounding: float, paint: Paint) -> tuple[Solid, Solid]:
    """The same solid on the right and, mirrored, on the left."""
    x, y, z = center
    return Solid(center, half, rounding, paint), Solid((-x, y, z), half, rounding, paint)


SOLIDS = (
    Solid((0, 0.42, 0), (0.34, 0.40, 0.27), 0.24, Paint(SKY, LEMON, (0, 0.26, 0))),
    Solid((0, 0.98, 0.02), (0.30, 0.26, 0.26), 0.23, _FUR),
    Solid((0, 0.92, 0.28), (0.13, 0.09, 0.08), 0.08, Paint(WINE, CREAM, (0.13, 0, 0), -0.2)),
    *_pair((0.25, 1.25, 0), (0.10, 0.15, 0.06), 0.06, _EAR),
    *_pair((0.11, 1.06, 0.25), (0.045, 0.05, 0.045), 0.045, _EYE),
    *_pair((0.46, 0.62, 0.06), (0.21, 0.095, 0.095), 0.09, _SLEEVE),
    *_pair((0.20, 0.09, 0.16), (0.13, 0.09, 0.18), 0.08, _SOLE),
)


# Twisting and bending build up from the toy's base: the feet do not move, ears and head turn as
# one.
_BENDING = Bending((0.3, 1.15), ((2, 0, Swing(0.45, 2.0, 0.0)), (0, 1, Swing(0.30, 3.0, -0.5))))
# Logarithm of the height's factor: it is squashed first and stretched later.
_SQUASH = Swing(-0.12, 4.0, 0.0)
TABLE = SolidTable(SOLIDS, BASE)


@dataclass(frozen=True)
class Plush:
    """A non-rigid :class:`~devrf.scenes.procedural.solids.Shape`; its parts are its solids.

    First its height is scaled by s about its base and its width and depth by 1/√s, which keeps
    the volume; then it turns about its base by angles that grow with the distance from it,
    which keep that distance. Both are undone exactly.

    Attributes:
        speed: scales squashing, bending and twisting.
    """

    speed: float = 1.0

    def distance(self, points: Tensor, time: float) -> Tensor:
        """A lower bound (M,): canonical distances over the largest stretch of the motion."""
        local = self._canonical(points - points.new_tensor(BASE), time)
        # Lengths grow by no more than 1/s up and √s across, back to the canonical state.
        height = self._height(time)
        longer = _BENDING.stretch(self.speed, time) * max(1 / height, math.sqrt(height))
        return 1 / longer * TABLE.distances_of(local).amin(dim=0)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest solid's material."""
        base = points.new_tensor(BASE)
        local = self._canonical(points - base, time)
        return Material(local + base, TABLE.distances_of(local).argmin(dim=0))

    def forward(self, material: Material, time: float) -> Tensor:
        """Squash, then bend and twist, all about the base."""
        base = material.canonical.new_tensor(BASE)
        height = self._height(time)
        x, y, z = (material.canonical - base).unbind(-1)
        squashed = torch.stack([x / math.sqrt(height), y * height, z / math.sqrt(height)], dim=-1)
        return _BENDING.bent(squashed, self.speed, time) + base

    def color(self, material: Material) -> Tensor:
        """The solids' paints."""
        return TABLE.painted.color(material)

    def _height(self, time: float) -> float:
        """s: the toy's height, relative to the canonical one."""
        return math.exp(_SQUASH(self.speed, time))

    def _canonical(self, local: Tensor, time: float) -> Tensor:
        """Canonical positions (M, 3) of points (M, 3), both relative to the base."""
        height = self._height(time)
        x, y, z = _BENDING.unbent(local, self.speed, time).unbind(-1)
        wide = math.sqrt(height)
        return torch.stack([x * wide, y / height, z * wide], dim=-1)

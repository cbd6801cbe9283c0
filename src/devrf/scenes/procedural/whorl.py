"""A whorl of petals: one petal's distance and motion, repeated around the blossom's axis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.flower_parts import HEAD, Whorl
from devrf.scenes.procedural.motion import rotation, stretch, turn
from devrf.scenes.procedural.sdf import blade

# Share of the opening that a petal turns by at its hinge; the rest builds up towards its tip.
_AT_HINGE = 0.6


@dataclass(frozen=True)
class PetalWhorl:
    """The petals of one ring, before the stem bends.

    A petal curls in the plane of the blossom's axis and its own: each point turns about the
    hinge by an angle that depends on its distance ρ from the hinge in that plane.

    Attributes:
        whorl: what the petals look like.
        first_part: part number of petal 0; the others follow.
    """

    whorl: Whorl
    first_part: int

    @property
    def count(self) -> int:
        """Number of petals."""
        return self.whorl.count

    def nearest(self, points: Tensor) -> Tensor:
        """Number (M,) of the petal whose sector holds each point (M, 3).

        The petals are equal and each is its own mirror image, so none is nearer.
        """
        sector = torch.atan2(points[:, 1], points[:, 0]) * (self.count / (2 * math.pi))
        return sector.round().long().remainder(self.count)

    def distance(self, points: Tensor, opening: float) -> Tensor:
        """Lower bound (M,) of the distance of points (M, 3) to the nearest petal."""
        w = self.whorl
        x, y, z = self._at_hinge(points, self.nearest(points))
        x, z = self._curl(x, z, -opening)
        x, z = turn(x, z, -w.elevation)
        shear = abs(w.opening * opening) * (1 - _AT_HINGE)
        flat = blade(x - w.half_length, y, z, w.half_length, w.half_width, w.thickness)
        return flat / stretch(shear)

    def curled(self, rest: Tensor, petal: Tensor, opening: float) -> Tensor:
        """Rest points (M, 3) of the petals (M,), opened."""
        x, y, z = self._at_hinge(rest, petal)
        x, z = self._curl(x, z, opening)
        return self._from_hinge(x, y, z, petal)

    def uncurled(self, points: Tensor, petal: Tensor, opening: float) -> Tensor:
        """The inverse of :meth:`curled`."""
        return self.curled(points, petal, -opening)

    def frame(self, petal: int) -> tuple[Tensor, Tensor]:
        """Axes (3, 3) as columns (along, across, normal) and hinge (3,) at rest, float64."""
        around = rotation((0, 0, 1), petal * 2 * math.pi / self.count)
        hinge = around @ torch.tensor([self.whorl.hinge, 0, 0], dtype=torch.float64)
        hinge = hinge + torch.tensor([0, 0, HEAD], dtype=torch.float64)
        return around @ rotation((0, 1, 0), -self.whorl.elevation), hinge

    def _curl(self, x: Tensor, z: Tensor, opening: float) -> tuple[Tensor, Tensor]:
        """Turn (x, z) about the hinge downward by opening · (share at hinge … 1 at the tip)."""
        rho = torch.hypot(x, z) / (2 * self.whorl.half_length)
        share = _AT_HINGE + (1 - _AT_HINGE) * rho.clamp_max(1)
        return turn(x, z, -self.whorl.opening * opening * share)

    def _angle(self, petal: Tensor, like: Tensor) -> Tensor:
        return petal.to(like) * (2 * math.pi / self.count)

    def _at_hinge(self, points: Tensor, petal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates outward, across and up from the petal's hinge."""
        x, y = turn(points[:, 0], points[:, 1], -self._angle(petal, points))
        return x - self.whorl.hinge, y, points[:, 2] - HEAD

    def _from_hinge(self, x: Tensor, y: Tensor, z: Tensor, petal: Tensor) -> Tensor:
        x, y = turn(x + self.whorl.hinge, y, self._angle(petal, x))
        return torch.stack([x, y, z + HEAD], dim=-1)

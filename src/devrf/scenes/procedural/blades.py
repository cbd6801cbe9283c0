"""The flower's blades: leaves, and petals that curl about their hinges."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.procedural.motion import rotation, stretch, turn
from devrf.scenes.procedural.sdf import blade
from devrf.scenes.procedural.texture import Paint

# Share of the opening that a petal turns by at its hinge; the rest builds up towards its tip.
_AT_HINGE = 0.6


@dataclass(frozen=True)
class Leaf:
    """A leaf on the stem, at rest; lengths in world units, angles in radians.

    Attributes:
        height: where it leaves the stem.
        azimuth: direction in which it points.
        elevation: angle above the horizon.
        half_length: half of its length.
        half_width: half of its width.
        thickness: its half thickness.
        paint: its texture.
    """

    height: float
    azimuth: float
    elevation: float
    half_length: float
    half_width: float
    thickness: float
    paint: Paint

    def frame(self) -> tuple[Tensor, Tensor]:
        """Axes (3, 3) as columns (along, across, normal) and hinge (3,), float64."""
        axes = rotation((0, 0, 1), self.azimuth) @ rotation((0, 1, 0), -self.elevation)
        return axes, torch.tensor([0, 0, self.height], dtype=torch.float64)

    def distance(self, local: Tensor) -> Tensor:
        """Distance (M,) of points (M, 3) in the leaf's frame."""
        x, y, z = local.unbind(-1)
        return blade(x - self.half_length, y, z, self.half_length, self.half_width, self.thickness)


@dataclass(frozen=True)
class Whorl:
    """A ring of equal petals around the z axis that open and close together.

    A petal curls in the plane of the blossom's axis and its own: each point turns about the
    hinge by an angle that depends on its distance ρ from the hinge in that plane. Lengths in
    world units, angles in radians; ``opening`` arguments are 0 at rest and 1 when open.

    Attributes:
        first_part: part number of petal 0; the others follow.
        count: number of petals.
        height: of the blossom's middle.
        hinge: distance of the hinges from the blossom's axis.
        elevation: angle above the horizon at which the petals stand at rest.
        opening: by how much their tips turn downward when open.
        half_length: half of a petal's length.
        half_width: half of a petal's width.
        thickness: its half thickness.
        paints: textures of the petals with even and with odd numbers.
    """

    first_part: int
    count: int
    height: float
    hinge: float
    elevation: float
    opening: float
    half_length: float
    half_width: float
    thickness: float
    paints: tuple[Paint, Paint]

    def frame(self, petal: int) -> tuple[Tensor, Tensor]:
        """Axes (3, 3) as columns (along, across, normal) and hinge (3,) at rest, float64."""
        around = rotation((0, 0, 1), petal * 2 * math.pi / self.count)
        hinge = around @ torch.tensor([self.hinge, 0, 0], dtype=torch.float64)
        hinge = hinge + torch.tensor([0, 0, self.height], dtype=torch.float64)
        return around @ rotation((0, 1, 0), -self.elevation), hinge

    def nearest(self, points: Tensor) -> Tensor:
        """Number (M,) of the petal whose sector holds each point (M, 3).

        The petals are equal and each is its own mirror image, so none is nearer.
        """
        sector = torch.atan2(points[:, 1], points[:, 0]) * (self.count / (2 * math.pi))
        return sector.round().long().remainder(self.count)

    def distance(self, points: Tensor, opening: float) -> Tensor:
        """Lower bound (M,) of the distance of points (M, 3) to the nearest petal."""
        x, y, z = self._at_hinge(points, self.nearest(points))
        x, z = self._curl(x, z, -opening)
        x, z = turn(x, z, -self.elevation)
        shear = abs(self.opening * opening) * (1 - _AT_HINGE)
        flat = blade(x - self.half_length, y, z, self.half_length, self.half_width, self.thickness)
        return flat / stretch(shear)

    def curled(self, rest: Tensor, petal: Tensor, opening: float) -> Tensor:
        """Rest points (M, 3) of the petals (M,), opened; the opposite opening undoes it."""
        x, y, z = self._at_hinge(rest, petal)
        x, z = self._curl(x, z, opening)
        x, y = turn(x + self.hinge, y, self._azimuth(petal, x))
        return torch.stack([x, y, z + self.height], dim=-1)

    def _curl(self, x: Tensor, z: Tensor, opening: float) -> tuple[Tensor, Tensor]:
        """Turn (x, z) about the hinge downward by opening · (share at hinge … 1 at the tip)."""
        rho = torch.hypot(x, z) / (2 * self.half_length)
        share = _AT_HINGE + (1 - _AT_HINGE) * rho.clamp_max(1)
        return turn(x, z, -self.opening * opening * share)

    def _azimuth(self, petal: Tensor, like: Tensor) -> Tensor:
        return petal.to(like) * (2 * math.pi / self.count)

    def _at_hinge(self, points: Tensor, petal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates outward, across and up from the petal's hinge."""
        x, y = turn(points[:, 0], points[:, 1], -self._azimuth(petal, points))
        return x - self.hinge, y, points[:, 2] - self.height

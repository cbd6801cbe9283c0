"""A moving shape among things that stand still: a room, or a wall behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from devrf.scenes.procedural.shape import Material, Shape


class Surroundings(Protocol):
    """Things around a shape, which stand still; each is a part."""

    @property
    def parts(self) -> int:
        """How many things there are."""
        ...

    def distances(self, points: Tensor) -> Tensor:
        """Lower bounds (K, M) of the distances of ``points`` (M, 3) to the K parts."""
        ...

    def color(self, material: Material) -> Tensor:
        """Albedo (M, 3) in [0, 1] of material of the parts, whatever it is for other material."""
        ...


@dataclass(frozen=True)
class Surrounded:
    """A :class:`~devrf.scenes.procedural.shape.Shape` among still surroundings.

    The first parts are those of the surroundings; the shape's own follow.

    Attributes:
        shape: what stands in the middle, and moves.
        surroundings: what stands still.
        reach: radius of a ball about the origin that holds the shape at all times, world units;
            None: its distance is cheap enough everywhere.
    """

    shape: Shape
    surroundings: Surroundings
    reach: float | None = None

    def distance(self, points: Tensor, time: float) -> Tensor:
        """The smaller of the shape's distance bound and the surroundings' (M,).

        Far from the shape its bound is the distance to the ball around it, where there is one.
        """
        still = self.surroundings.distances(points).amin(dim=0)
        if self.reach is None:
            return torch.minimum(still, self.shape.distance(points, time))
        ball = points.norm(dim=-1) - self.reach
        near = (ball < 0.1 * self.reach).nonzero().squeeze(-1)
        ball[near] = self.shape.distance(points[near], time)
        return torch.minimum(still, ball)

    def material(self, points: Tensor, time: float) -> Material:
        """The nearest thing's material; that of the surroundings is where it is."""
        still, part = self.surroundings.distances(points).min(dim=0)
        own = self.shape.material(points, time)
        nearer = self.shape.distance(points, time) < still
        return Material(
            torch.where(nearer[:, None], own.rest, points),
            torch.where(nearer, own.part + self.surroundings.parts, part),
        )

    def forward(self, material: Material, time: float) -> Tensor:
        """Where the shape goes; the surroundings stay."""
        moved = self.shape.forward(self._of_shape(material), time)
        return torch.where(self._is_shape(material), moved, material.rest)

    def color(self, material: Material) -> Tensor:
        """The shape's paint, or that of its surroundings."""
        own = self.shape.color(self._of_shape(material))
        return torch.where(self._is_shape(material), own, self.surroundings.color(material))

    def _is_shape(self, material: Material) -> Tensor:
        """(M, 1) bool: which material is of the shape."""
        return (material.part >= self.surroundings.parts)[:, None]

    def _of_shape(self, material: Material) -> Material:
        """The material with the shape's own part numbers, where it is of the shape."""
        return Material(material.rest, (material.part - self.surroundings.parts).clamp_min(0))

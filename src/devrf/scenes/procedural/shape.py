"""What a moving shape can be asked: all of it exact, at any time in [0, 1]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True)
class Material:
    """M material points: the name a point of the object keeps while it moves.

    Attributes:
        rest: (M, 3) where the points are at t = 0, world units.
        part: (M,) int64, which part of the object each belongs to.
    """

    rest: Tensor
    part: Tensor


class Shape(Protocol):
    """A textured solid that deforms; at t = 0 it is at rest."""

    def distance(self, points: Tensor, time: float) -> Tensor:
        """Lower bound (M,) of the distance of ``points`` (M, 3) to the surface at ``time``.

        Zero on the surface only, negative inside.
        """
        ...

    def material(self, points: Tensor, time: float) -> Material:
        """Which material is at world ``points`` (M, 3) on (or near) the surface at ``time``.

        ``material(points, time).rest`` is the exact backward warp.
        """
        ...

    def forward(self, material: Material, time: float) -> Tensor:
        """Where the material is at ``time``: (M, 3) world units; ``material.rest`` at t = 0."""
        ...

    def color(self, material: Material) -> Tensor:
        """Albedo (M, 3) in [0, 1]: it depends on the material alone, so it moves with it."""
        ...


class BoundedShape(Shape, Protocol):
    """A shape that ends somewhere."""

    def outline(self) -> Material:
        """Material points around every part, so that their bounding box holds the object."""
        ...

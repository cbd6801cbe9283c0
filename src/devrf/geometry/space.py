"""The space that fields live in: the world itself, or a frustum made into a box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from devrf.geometry.rays import Rays


class Space(Protocol):
    """A mapping between world space and the space of the fields.

    :class:`WorldSpace` for inward-facing scenes,
    :class:`~devrf.geometry.ndc.NormalizedDevice` for forward-facing ones.
    """

    def from_world(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the world in the fields' space."""
        ...

    def to_world(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the fields' space in the world."""
        ...

    def rays(self, rays: Rays) -> Rays:
        """World rays in the fields' space; their view directions stay those of the world."""
        ...


@dataclass(frozen=True)
class WorldSpace:
    """Fields that live in world space: nothing is mapped."""

    def from_world(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def to_world(self, points: Tensor) -> Tensor:
        """The points themselves."""
        return points

    def rays(self, rays: Rays) -> Rays:
        """The rays themselves."""
        return rays


WORLD = WorldSpace()

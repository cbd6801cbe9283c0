"""The networks' normalised space, and its maps to the world."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.geometry.box import Box, constant
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import Space

# The largest z' of points in NDC, where infinity is at 1: a flow may lead them further.
FURTHEST = 0.99
# The least distance of a camera from what NDC holds, in those of the near plane from the origin.
NEAREST = 0.1
# The least near limit, in :attr:`Placement.unit`: files and options may say 0.
LEAST_LIMIT = 1e-3


@dataclass(frozen=True)
class Placement:
    """Normalised space: the fields' box, centred, its longest edge being 2.

    Attributes:
        box: holds the scene, in the fields' space.
        space: the fields' space.
    """

    box: Box
    space: Space

    @property
    def half_edge(self) -> float:
        """The length in the fields' space of 1 in normalised space."""
        return self.box.longest / 2

    @property
    def unit(self) -> float:
        """World units that :meth:`euclidean` counts as 1: about the size of the near scene."""
        if isinstance(self.space, NormalizedDevice):
            return self.space.near
        return self.space.inner(self.box).longest / 2

    def near(self, limit: float, positions: Tensor) -> float:
        """The least distance of the scene from cameras at ``positions`` (N, 3), in world units.

        It is above 0.

        Args:
            limit: that of the fields' space, where samples begin along a ray.
            positions: of the cameras, in the world.
        """
        if not isinstance(self.space, NormalizedDevice):
            return max(limit, LEAST_LIMIT * self.unit)
        plane = self.space.near
        return max(plane + float(positions[:, 2].min()), NEAREST * plane)

    def normalised(self, points: Tensor) -> Tensor:
        """Normalised points (..., 3) of the fields' space."""
        return (points - constant(self.box.middle, points.dtype, points.device)) / self.half_edge

    def fields(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the fields' space: the inverse of :meth:`normalised`."""
        return points * self.half_edge + points.new_tensor(self.box.middle)

    def world(self, points: Tensor) -> Tensor:
        """World points (..., 3) of normalised ones; in NDC none behind :data:`FURTHEST`."""
        field_points = self.fields(points)
        if isinstance(self.space, NormalizedDevice):
            limit = field_points.new_tensor([float("inf"), float("inf"), FURTHEST])
            field_points = field_points.minimum(limit)
        return self.space.to_world(field_points)

    def euclidean(self, points: Tensor) -> Tensor:
        """World points (..., 3) of normalised ones, in units of :attr:`unit`."""
        return self.world(points) / self.unit

    def within(self, points: Tensor, share: float) -> Tensor:
        """Mask (S,) of normalised points (S, 3) that are near enough to be held smooth.

        They are those of the nearest ``share`` of depths in NDC, and elsewhere the whole subject.
        """
        field_points = self.fields(points)
        if isinstance(self.space, NormalizedDevice):
            return (field_points[..., 2] + 1) / 2 <= share
        return self.space.inner(self.box).contains(field_points)

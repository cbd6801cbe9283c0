"""Scene contraction: all of space becomes a box (docs/method.md#scene-contraction).

An inner box stays as it is; the space around it is squeezed into a shell. With
u = (x − c) / h, c the inner box's centre and h its half edges, and m = max |u_i| > 1, a point goes
to c + h (1 + b − b/m) u/m: its direction stays, and infinity is on the faces of c ± (1 + b) h
(mip-NeRF 360's contraction, with boxes in place of balls).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays

Xyz = tuple[float, float, float]

# Points nearer to the outer faces than this share of the shell are taken to be at this distance: a
# float32 can still distinguish a distance of a million inner boxes from infinity.
INFINITY = 1e-6
# Most rays move no more contracted units than this in a unit of their distance.
PACE = 1.25


@dataclass(frozen=True)
class ContractedSpace:
    """The mapping between world space and contracted space.

    Attributes:
        low: the corner (x, y, z) of the inner box with the smallest coordinates, world units.
        high: the one with the largest.
        shell: b, the shell's thickness in half edges of the inner box.
    """

    low: Xyz
    high: Xyz
    shell: float = 1.0

    is_linear: ClassVar[bool] = False

    def __post_init__(self) -> None:
        Box(self.low, self.high)  # it refuses other corners

    @property
    def side_factor(self) -> float:
        """0.8 (1 + b): the fields' box is 1 + b times as long as the inner box along every axis.

        The inner box gives up a fifth of its resolution for that of the shell.
        """
        return 0.8 * (1 + self.shell)

    @property
    def box(self) -> Box:
        """The fields' box, c ± (1 + b) h; its faces are infinitely far away."""
        return Box(self.low, self.high).scaled(1 + self.shell)

    def inner(self, box: Box | None = None) -> Box:
        """The inner box, where coordinates are the world's."""
        return Box(self.low, self.high)

    def from_world(self, points: Tensor) -> Tensor:
        """Contracted (..., 3) of world points (..., 3); those of the inner box as they are."""
        center, half = self._frame(points)
        u = (points - center) / half
        m = u.abs().amax(dim=-1, keepdim=True).clamp(min=1)
        squeezed = center + half * ((1 + self.shell - self.shell / m) / m) * u
        return torch.where(m > 1, squeezed, points)

    def to_world(self, points: Tensor) -> Tensor:
        """World points (..., 3) of contracted ones (..., 3): the inverse of :meth:`from_world`.

        Points on the outer faces become very distant, not infinite.
        """
        center, half = self._frame(points)
        u = (points - center) / half
        m = u.abs().amax(dim=-1, keepdim=True).clamp(min=1)
        gap = (1 + self.shell - m).clamp(min=INFINITY * self.shell)
        return torch.where(m > 1, center + half * (self.shell / gap / m) * u, points)

    def rays(self, rays: Rays) -> ContractedRays:
        """World rays, whose points are in contracted space (:class:`ContractedRays`)."""
        center, half = self._frame(rays.origins)
        origin = (rays.origins - center) / half
        slope = rays.directions / half
        axis = slope.abs().argmax(dim=-1, keepdim=True)
        along = origin.gather(1, axis)
        pace = slope.gather(1, axis)
        # A ray's sideways pace in the shell, if it does not lead away from the centre.
        sideways = (slope * along - origin * pace).abs().amax(dim=-1) / pace[:, 0].abs()
        stretch = (0.5 * (1 + self.shell) * sideways).clamp(min=self.shell)
        start = along[:, 0] * pace[:, 0].sign()
        return ContractedRays(
            rays.origins,
            rays.directions,
            rays.viewdirs,
            self,
            torch.stack([start, pace[:, 0].abs(), stretch], dim=-1),
        )

    def depths(self, rays: Rays, distance: Tensor) -> Tensor:
        """Distances s (M,) of points so far along M world rays (:class:`ContractedRays`)."""
        return self.rays(rays).own_distance(distance)

    def depth_range(
        self, box: Box, limits: tuple[float, float], position: Tensor
    ) -> tuple[float, float]:
        """From the camera to the outer face behind the centre, in contracted rays' own distance.

        That is world units in the inner box, as for :class:`ContractedRays`.
        """
        center, half = self._frame(position)
        away = float(((position - center) / half).abs().amax())
        squeezed = min(away, 1 + self.shell * (1 - 1 / max(away, 1.0)))
        unit = float(half.mean())
        return unit * (away - squeezed), unit * (away + 1 + self.shell)

    def _frame(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Centre and half edges (3,) of the inner box."""
        low, high = Box(self.low, self.high).corners(like)
        return (low + high) / 2, (high - low) / 2


@dataclass(frozen=True)
class ContractedRays(Rays):
    """World rays whose distance grows evenly with the way they go in contracted space.

    Along the axis that a ray crosses fastest, in half edges from the centre, let it be at
    x(t) = x_o + k t, k > 0, after t world units. Its distance is s = t while |x| ≤ 1, and beyond
    grows with y = ± (1 + β (1 − 1/|x|)) as s = (y − x_o) / k would: in proportion to disparity.
    β is b, and larger for a ray that goes sideways through the shell, so that a step of it is
    nowhere much longer in contracted space than in s.

    Attributes:
        origins: (M, 3) start points, in the world.
        directions: (M, 3) unit vectors, in the world.
        space: the space that points are in.
        course: (M, 3) x_o, k and β of each ray.
    """

    space: ContractedSpace
    course: Tensor

    def at(self, ray: Tensor, distance: Tensor) -> Tensor:
        """Points (S, 3) in contracted space; those in the inner box are the world rays'."""
        return self.space.from_world(super().at(ray, self.world_distance(ray, distance)))

    def world_distance(self, ray: Tensor, distance: Tensor) -> Tensor:
        """t (S,), world units from the rays' origins, of distances s (S,)."""
        start, pace, stretch = self.course.t().contiguous().index_select(1, ray).unbind(0)
        y = torch.addcmul(start, pace, distance)
        disparity = (1 - (y.abs() - 1) / stretch).clamp(min=INFINITY)
        x = y.sign() / disparity
        return torch.where(y.abs() > 1, (x - start) / pace, distance)

    def crossing(self, low: Tensor, high: Tensor, near: float, far: float) -> tuple[Tensor, Tensor]:
        """Distances s (M,), (M,) of the world distances ``near`` and ``far``, infinity included.

        The fields' box holds all of space, so its corners do not matter.
        """
        return self.own_distance(near), self.own_distance(far)

    def longest(
        self, low: Sequence[float], high: Sequence[float], near: float, far: float
    ) -> float:
        """From the one face of contracted space to the other; the host waits for it."""
        _, pace, stretch = self.course.unbind(-1)
        return float((2 * (1 + stretch) / pace).amax()) if len(self) else 0.0

    @property
    def pace(self) -> float:
        """A bound for most rays; sideways through the shell they may be three times as fast."""
        return PACE

    def ends(self) -> Tensor:
        """The points (M, 3) of the outer faces that rays lead to."""
        every = torch.arange(len(self), device=self.origins.device)
        return self.at(every, self.own_distance(math.inf))

    def own_distance(self, world: Tensor | float) -> Tensor:
        """s (M,) of world distances (M,), or of one of all rays."""
        start, pace, stretch = self.course.unbind(-1)
        x = start + pace * world
        y = x.sign() * (1 + stretch * (1 - 1 / x.abs().clamp(min=1)))
        return torch.where(x.abs() > 1, (y - start) / pace, world)

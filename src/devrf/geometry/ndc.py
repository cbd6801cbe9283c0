"""Normalised device coordinates: an unbounded frustum becomes a box (forward-facing scenes).

With a camera at the origin that looks along −z, focal length f, width W, height H and near
plane n, a point (x, y, z) maps to (−f·x/(W/2·z), −f·y/(H/2·z), 1 + 2n/z), in [−1, 1]³: the
near plane to z' = −1, infinity to z' = 1 (NeRF, appendix C).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from devrf.geometry.box import Box, constant
from devrf.geometry.rays import Rays

# A point at z' = 1 is moved so much nearer, to two million near planes: at infinity its pixel, and
# all that is learned from it, would be NaN.
BEFORE_INFINITY = 1e-6
# Rays whose z falls by less than this a unit never cross the near plane. They begin at BEYOND.
AHEAD = 1e-3
BEYOND = 3.0


@dataclass(frozen=True)
class NormalizedDevice:
    """The mapping between world space and NDC of one reference camera.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        focal: focal lengths (fx, fy) in pixels.
        near: distance of the near plane in world units.
    """

    width: int
    height: int
    focal: tuple[float, float]
    near: float = 1.0

    is_linear: ClassVar[bool] = True
    side_factor: ClassVar[float] = 1.0

    def inner(self, box: Box) -> Box:
        """All of the box."""
        return box

    @property
    def slopes(self) -> tuple[float, float]:
        """2f/W and 2f/H."""
        return 2 * self.focal[0] / self.width, 2 * self.focal[1] / self.height

    def from_world(self, points: Tensor) -> Tensor:
        """NDC (..., 3) of world points (..., 3) with z < 0."""
        sx, sy = self.slopes
        x, y, z = points.unbind(-1)
        return torch.stack([-sx * x / z, -sy * y / z, 1 + 2 * self.near / z], dim=-1)

    def to_world(self, points: Tensor) -> Tensor:
        """World points (..., 3) of NDC (..., 3) with z' < 1: the inverse of :meth:`from_world`.

        Points at infinity come out far away, at a finite distance.
        """
        sx, sy = self.slopes
        x, y, z = points.unbind(-1)
        gap = z - 1
        depth = 2 * self.near / torch.where(gap == 0, -BEFORE_INFINITY, gap)
        return torch.stack([-x * depth / sx, -y * depth / sy, depth], dim=-1)

    def rays(self, rays: Rays) -> Rays:
        """World rays as NDC rays: origin on the near plane, origin + direction at infinity.

        The view directions stay those of the world. Rays that look back or aside meet nothing:
        extended backwards they would see what is behind their camera.
        """
        o = rays.origins
        ahead = rays.directions[:, 2:] < -AHEAD
        d = torch.where(ahead, rays.directions, constant((0.0, 0.0, -1.0), o.dtype, o.device))
        start = o + d * (-(self.near + o[:, 2:]) / d[:, 2:])
        sx, sy = self.slopes
        origin = torch.where(ahead, self.from_world(start), BEYOND)
        x = -sx * (d[:, 0] / d[:, 2] - start[:, 0] / start[:, 2])
        y = -sy * (d[:, 1] / d[:, 2] - start[:, 1] / start[:, 2])
        z = -2 * self.near / start[:, 2]
        return Rays(origin, torch.stack([x, y, z], dim=-1), rays.viewdirs)

    def depths(self, rays: Rays, distance: Tensor) -> Tensor:
        """Shares (M,) of the way from the near plane to infinity of points so far along M rays."""
        points = rays.origins + distance[:, None] * rays.directions
        field_rays = self.rays(rays)
        return (self.from_world(points) - field_rays.origins)[:, 2] / field_rays.directions[:, 2]

    def depth_range(
        self, box: Box, limits: tuple[float, float], position: Tensor
    ) -> tuple[float, float]:
        """The limits themselves: every ray goes from the near plane to infinity."""
        return limits

"""Where NSFF samples rays: there is no second pass."""

from __future__ import annotations

from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.hierarchical import flattened, limits, stratified
from devrf.methods.nerf.occupancy_frames import OccupancyFrames
from devrf.methods.nerf.ray_samples import RaySamples


def evenly(
    rays: Rays, box: Box, depths: tuple[float, float], count: int, *, jitter: bool
) -> RaySamples:
    """``count`` samples of each ray, one in each of equal stretches of its way through a box."""
    near, far = limits(rays, box, depths)
    return flattened(rays, stratified(near, far, count, jitter=jitter), far)


def occupied(
    rays: Rays,
    frames: tuple[Tensor, Tensor],
    box: Box,
    depths: tuple[float, float],
    occupancy: OccupancyFrames,
    steps: int,
    *,
    jitter: bool,
) -> RaySamples:
    """Even steps, ``steps`` along the box's diagonal, where something may be at either frame."""
    diagonal = sum(edge**2 for edge in box.size) ** 0.5
    unit = float(rays.directions.norm(dim=1).amax()) if len(rays) else 1.0
    step = diagonal / (steps * unit)
    return occupancy.march(rays, frames, box, depths, step, jitter=jitter)

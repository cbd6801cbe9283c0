"""Where NSFF samples rays: there is no second pass."""

from __future__ import annotations

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.hierarchical import flattened, limits, stratified
from devrf.methods.nerf.ray_samples import RaySamples


def evenly(
    rays: Rays, box: Box, depths: tuple[float, float], count: int, *, jitter: bool
) -> RaySamples:
    """``count`` samples of each ray, one in each of equal stretches of its way through a box."""
    near, far = limits(rays, box, depths)
    return flattened(rays, stratified(near, far, count, jitter=jitter), far)

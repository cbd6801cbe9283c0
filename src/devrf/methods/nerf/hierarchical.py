"""Hierarchical sampling: evenly spread samples, then more where the first ones have weight."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.ray_samples import RaySamples


def limits(rays: Rays, box: Box, depths: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Distances (R,) between which R rays are sampled: inside the box, from near to far.

    A ray that misses the box is sampled in a stretch of no length.
    """
    entry, leave = box.crossing(rays, *depths)
    near = entry.clamp(max=depths[1])
    return near, torch.maximum(leave, near)


def stratified(near: Tensor, far: Tensor, count: int, *, jitter: bool) -> Tensor:
    """Distances (R, count), one in each of as many equal stretches.

    Args:
        near: (R,) where the first stretch begins.
        far: (R,) where the last one ends.
        count: how many stretches.
        jitter: a random place in each stretch; else its middle.
    """
    place = torch.arange(count, device=near.device).expand(len(near), count)
    offset = torch.rand_like(near[:, None].expand(-1, count)) if jitter else 0.5
    return near[:, None] + (far - near)[:, None] * (place + offset) / count


def importance(
    distance: Tensor, weight: Tensor, near: Tensor, far: Tensor, count: int, *, jitter: bool
) -> Tensor:
    """Distances (R, count) drawn in proportion to the weights of coarse samples.

    The stretches end half-way between the coarse samples; each is as likely as its weight says,
    and a place within it is drawn evenly (inverse transform sampling).

    Args:
        distance: (R, N) of the coarse samples, ascending.
        weight: (R, N) theirs.
        near: (R,) where the first stretch begins.
        far: (R,) where the last one ends.
        count: how many to draw.
        jitter: random numbers; else evenly spread ones.
    """
    middle = (distance[:, 1:] + distance[:, :-1]) / 2
    edge = torch.cat([near[:, None], middle, far[:, None]], dim=1)
    share = weight + 1e-5
    reached = torch.cumsum(share / share.sum(dim=1, keepdim=True), dim=1)
    reached = torch.cat([torch.zeros_like(reached[:, :1]), reached], dim=1)
    wanted = stratified(torch.zeros_like(near), torch.ones_like(far), count, jitter=jitter)
    above = torch.searchsorted(reached, wanted.contiguous(), right=True)
    above = above.clamp(min=1, max=edge.shape[1] - 1)
    low, high = reached.gather(1, above - 1), reached.gather(1, above)
    within = ((wanted - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)
    start, stop = edge.gather(1, above - 1), edge.gather(1, above)
    return start + within * (stop - start)


def flattened(rays: Rays, distance: Tensor, far: Tensor) -> RaySamples:
    """Samples at distances (R, N), ascending: each stands for the stretch up to the next."""
    stretch = torch.cat([distance[:, 1:], far[:, None]], dim=1) - distance
    ray = torch.arange(len(rays), device=distance.device).repeat_interleave(distance.shape[1])
    return RaySamples.at(rays, ray, distance.reshape(-1), stretch.reshape(-1).clamp(min=0))

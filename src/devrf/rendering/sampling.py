"""Sample points along rays, in occupied space only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.ops.pixel_rays import steps_between
from devrf.rendering.occupancy import Occupancy

# A ray ends where its transmittance is less: what is behind cannot be seen.
STOP = 1e-4
# The least distance between samples, in voxels: with less a ray fills memory and shows no more.
FINEST = 0.01


@dataclass(frozen=True)
class RenderSettings:
    """How rays are sampled at the present resolution.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, are dropped before
            their colour is computed.
        near: distance before which nothing is sampled, in world units (or NDC).
        far: distance behind which nothing is sampled, likewise.
    """

    step: float
    alpha_threshold: float
    near: float
    far: float

    def __post_init__(self) -> None:
        expect(self.step >= FINEST, "sampling.step", f"at least {FINEST}", self.step)


@dataclass(frozen=True)
class Samples:
    """S samples of R rays: ascending by ray, then front to back.

    Attributes:
        ray: (S,) int64, the ray of each sample.
        distance: (S,) along the ray, in units of its direction.
        points: (S, 3) positions in the fields' space.
        rays: R.
    """

    ray: Tensor
    distance: Tensor
    points: Tensor
    rays: int

    def __len__(self) -> int:
        return self.ray.shape[0]

    def __getitem__(self, index: Tensor) -> Samples:
        """The samples at ascending positions ``index`` (K,)."""
        return Samples(
            self.ray.index_select(0, index),
            self.distance.index_select(0, index),
            self.points.t().index_select(1, index).t(),
            self.rays,
        )


def steps_through(
    rays: Rays, box: Box, *, step: float, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Distance (R,) of each ray's first sample, and number (R,) int64 of samples up to its exit."""
    entry, leave = box.crossing(rays, near, far)
    return entry, steps_between(entry, leave, step)


@dataclass(frozen=True)
class Segments:
    """Segments of rays that pass near something: ascending by ray, then front to back.

    Attributes:
        ray: (M,) int64, the ray of each.
        start: (M,) int64, the number of its first sample on that ray.
        length: samples of a segment; the last of a ray may end behind the box.
        entry: (R,) the distance of each ray's first sample.
        count: (R,) int64 each ray's samples up to its exit.
        step: the distance between samples.
    """

    ray: Tensor
    start: Tensor
    length: int
    entry: Tensor
    count: Tensor
    step: float

    def __getitem__(self, index: Tensor) -> Segments:
        """The segments at ascending positions ``index`` (K,)."""
        ray, start = self.ray.index_select(0, index), self.start.index_select(0, index)
        return replace(self, ray=ray, start=start)

    def samples(self, rays: Rays, occupancy: Occupancy) -> Samples:
        """Their samples in occupied cells."""
        offset = torch.arange(self.length, device=self.ray.device)
        number = (self.start[:, None] + offset).reshape(-1)
        ray = self.ray.repeat_interleave(self.length)
        distance = self.entry.index_select(0, ray).add_(number, alpha=self.step)
        points = rays.at(ray, distance)
        occupied = occupancy.at(points) & (number < self.count.index_select(0, ray))
        return Samples(ray, distance, points, len(rays))[occupied.nonzero()[:, 0]]


@torch.no_grad()
def segments_near(
    rays: Rays, box: Box, occupancy: Occupancy, *, step: float, near: float, far: float
) -> Segments:
    """The segments of R rays, between entry into the box and exit, that pass near something.

    ``step`` is in units of the rays' directions; nothing is before ``near`` or behind ``far``.
    """
    entry, count = steps_through(rays, box, step=step, near=near, far=far)
    length = max(1, int(2 * _reach(rays, occupancy) / step))
    segments = (count + length - 1) // length
    ray = torch.repeat_interleave(segments)
    first = segments.cumsum(0) - segments
    start = torch.arange(len(ray), device=ray.device).sub_(first.index_select(0, ray))
    start *= length
    middle = entry.index_select(0, ray) + step * (start + (length - 1) / 2)
    found = _near(rays, ray, middle, occupancy).nonzero()[:, 0]
    return Segments(ray, start, length, entry, count, step)[found]


@torch.no_grad()
def march(
    rays: Rays, box: Box, occupancy: Occupancy, *, step: float, near: float, far: float
) -> Samples:
    """Samples every ``step`` along rays between their entry into the box and their exit.

    Empty space is skipped in two passes: first whole segments of a ray, then single samples.
    The samples in occupied cells are returned; the k-th of a ray is at entry + k·step.
    Arguments as for :func:`segments_near`.
    """
    limits = {"step": step, "near": near, "far": far}
    return segments_near(rays, box, occupancy, **limits).samples(rays, occupancy)


def _reach(rays: Rays, occupancy: Occupancy) -> float:
    """The vicinity's reach in units of the rays' distance, which in NDC are not the space's."""
    return occupancy.reach / max(rays.pace, 1e-9) if len(rays) else occupancy.reach


def _near(rays: Rays, ray: Tensor, middle: Tensor, occupancy: Occupancy) -> Tensor:
    """Mask (M,): whether something may be in the segments of rays with such middles.

    All of a ray's segments, one after another. Where a curved ray is faster than its pace, a
    segment may be longer than the vicinity reaches: something may be there, too.
    """
    points = rays.at(ray, middle)
    near = occupancy.near(points)
    if rays.is_curved:
        moved = (points[1:] - points[:-1]).abs().amax(dim=1)
        follows = ray[1:] == ray[:-1]
        fast = (moved > 2 * occupancy.reach) & follows
        near[1:] |= fast
        near[:-1] |= fast
    return near


@torch.no_grad()
def hits(
    rays: Rays, box: Box, occupancy: Occupancy, *, near: float, far: float, chunk: int = 65536
) -> Tensor:
    """Mask (R,): which rays pass within reach of an occupied cell."""
    parts = (rays[k : k + chunk] for k in range(0, max(len(rays), 1), chunk))
    return torch.cat([_hits(part, box, occupancy, near, far) for part in parts])


def _hits(rays: Rays, box: Box, occupancy: Occupancy, near: float, far: float) -> Tensor:
    entry, leave = box.crossing(rays, near, far)
    stride = _reach(rays, occupancy)
    strides = ((leave - entry) / stride).clamp(min=0).ceil().long()
    ray = torch.repeat_interleave(strides)
    first = strides.cumsum(0) - strides
    number = torch.arange(len(ray), device=ray.device) - first[ray]
    touched = _near(rays, ray, entry[ray] + (number + 0.5) * stride, occupancy)
    hit = torch.zeros(len(rays), dtype=torch.bool, device=ray.device)
    hit[ray[touched]] = True
    return hit

"""The visible samples of rays, found without gradients before a batch is rendered.

Lists have a fixed length, and only the device knows how much of them is used: a loop built on them
never waits for the device, and can be captured in a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from devrf.ops.compositing import transmittances
from devrf.ops.corners import Corners, shape_of, to_grid
from devrf.ops.warped_depth import warped_depth


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of visibility.

    Attributes:
        alpha: a sample of lower opacity is dropped.
        stop: a sample is dropped if the transmittance before it is lower.
        weight: a sample of lower weight T·α is not significant.
    """

    alpha: float
    stop: float
    weight: float


@dataclass(frozen=True)
class PackedSamples:
    """Samples of R rays in lists of length C: ascending by ray, front to back, then padding.

    Attributes:
        ray: (C,) int64, the ray of each sample; R in the padding.
        distance: (C,) along the ray, in units of its direction; 0 in the padding.
        points: (C, 3) positions; 0 in the padding.
        significant: (C,) bool, whether the sample's weight is high enough to need its colour.
        first: (R + 1,) int64, the place where each ray's samples begin; the last entry is the
            number of places used.
        total: () int64, the number of visible samples; more than C if some were dropped.
        steps: (R,) how many samples each ray was to be searched for.
        longest: how many it was searched for at most.
    """

    ray: Tensor
    distance: Tensor
    points: Tensor
    significant: Tensor
    first: Tensor
    total: Tensor
    steps: Tensor
    longest: int

    @property
    def overflow(self) -> Tensor:
        """() bool, whether any samples were dropped."""
        return (self.total > len(self.ray)) | (self.steps > self.longest).any()


class ListedSubset(NamedTuple):
    """Some of the samples of a list, in a list of length K, with what is known of them.

    Padding repeats other places of the list: it has any ray and position and no weight, and nothing
    gets a gradient through it. The places differ, so that atomic additions to them do not collide.

    Attributes:
        first: (R + 1,) int64, as in :class:`PackedSamples`, for the new list.
        total: () int64, the number of selected samples; more than K if some were dropped.
        ray: (K,) int64, the ray of each; in the padding any ray, spread over all.
        distance: (K,) along the ray.
        points: (K, 3) positions.
        present: (K,) bool, which places hold a sample.
        canonical: (K, 3) canonical positions.
        weight: (K,) weights, 0 in the padding.
    """

    first: Tensor
    total: Tensor
    ray: Tensor
    distance: Tensor
    points: Tensor
    present: Tensor
    canonical: Tensor
    weight: Tensor


@torch.no_grad()
def find_samples(
    origins: Tensor,
    directions: Tensor,
    entry: Tensor,
    count: Tensor,
    mask: Tensor,
    density: Tensor,
    slices: Sequence[Tensor] = (),
    weight: float = 0.0,
    *,
    step: float,
    longest: int,
    capacity: int,
    mask_box: Corners,
    box: Corners,
    shift: float,
    delta: float,
    thresholds: Thresholds,
) -> PackedSamples:
    """Visible samples among those at ``entry + k·step``, k = 0 … count − 1.

    A sample is kept if the grid point nearest to it is occupied, its opacity is no less than
    ``thresholds.alpha``, and the transmittance before it, over the samples in front of it that
    pass both tests, is no less than ``thresholds.stop``. It is significant if also its weight is
    no less than ``thresholds.weight``. Without gradients.

    Args:
        origins: (R, 3) of rays in the box's units.
        directions: (R, 3) of rays.
        entry: (R,) distance of each ray's first sample, in units of its direction.
        count: (R,) number of samples of each ray; int64 or int32.
        mask: (X, Y, Z) bool, the occupancy at the time of the rays.
        density: raw densities; as ``slices``, ``weight``, ``box``, ``shift`` and ``delta`` for
            :func:`~devrf.ops.warped_depth.warped_depth`.
        slices: displacements: none, one, or two.
        weight: of the second slice.
        step: distance between samples, in units of the rays' directions.
        longest: an upper bound of ``count``; further samples of a ray are dropped.
        capacity: C, the length of the lists; samples that do not fit are dropped.
        mask_box: the box of the mask; outside it everything is empty.
        box: the box of density and displacements.
        shift: added to a raw density.
        delta: the length of a step in base voxels.
        thresholds: thresholds of visibility.

    Returns:
        The samples; ``overflow`` is True if ``capacity`` or ``longest`` was too small.
    """
    rays = len(origins)
    samples = count.clamp(max=longest)
    ray = torch.repeat_interleave(samples)
    number = torch.arange(len(ray), device=ray.device) - (samples.cumsum(0) - samples)[ray]
    distance = torch.add(entry[ray], number, alpha=step)
    points = torch.addcmul(origins[ray], directions[ray], distance[:, None])
    index = _occupied(mask, to_grid(points, mask_box, shape_of(mask))).nonzero()[:, 0]
    ray, distance, points = ray[index], distance[index], points[index]
    _, tau = warped_depth(points, density, slices, weight, box=box, shift=shift, delta=delta)
    alpha = -torch.expm1(-tau)
    index = (alpha >= thresholds.alpha).nonzero()[:, 0]
    ray, distance, points = ray[index], distance[index], points[index]
    before = transmittances(tau[index], ray, rays)
    significant = before * alpha[index] >= thresholds.weight
    index = (before >= thresholds.stop).nonzero()[:, 0]
    first = torch.searchsorted(ray[index], torch.arange(rays + 1, device=ray.device))
    total = first[-1]
    index = index[:capacity]
    room = capacity - len(index)
    return PackedSamples(
        pad(ray[index], (0, room), value=rays),
        pad(distance[index], (0, room)),
        pad(points[index], (0, 0, 0, room)),
        pad(significant[index], (0, room)),
        first.clamp(max=capacity),
        total,
        count,
        longest,
    )


def _occupied(mask: Tensor, coords: Tensor) -> Tensor:
    """Mask (M,): whether the grid point nearest to coordinates (M, 3) exists and is True."""
    x, y, z = mask.shape
    i, j, k = coords.round().to(torch.int32).unbind(-1)
    inside = (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k >= 0) & (k < z)
    row = torch.where(inside, (i * y + j) * z + k, 0)
    return mask.reshape(-1)[row] & inside


def select_listed(
    packed: PackedSamples, canonical: Tensor, weight: Tensor, capacity: int
) -> ListedSubset:
    """The significant samples of a list, without waiting for the device.

    Args:
        packed: C samples.
        canonical: (C, 3) their canonical positions.
        weight: (C,) their weights.
        capacity: K ≤ C, the length of the new list; samples that do not fit are dropped.

    Returns:
        The new list, differentiable once in ``canonical`` and ``weight``.
    """
    rays = len(packed.first) - 1
    if capacity > len(packed.ray):
        raise ValueError(f"{capacity} of {len(packed.ray)} samples cannot be selected")
    flags, running = packed.significant, pad(packed.significant.cumsum(0), (1, 0))
    # One extra place receives everything that is not selected.
    target = torch.where(flags, running[:-1], capacity).clamp_(max=capacity)
    index = torch.arange(capacity + 1, device=flags.device)
    index.scatter_(0, target, torch.arange(len(flags), device=flags.device))
    index, first = index[:capacity], running[packed.first].clamp_(max=capacity)
    place = torch.arange(capacity, device=flags.device)
    present = place < first[-1]
    taken = canonical.index_select(0, index)
    return ListedSubset(
        first,
        running[-1],
        torch.where(present, packed.ray.index_select(0, index), place % max(rays, 1)),
        packed.distance.index_select(0, index),
        packed.points.index_select(0, index),
        present,
        torch.where(present[:, None], taken, taken.detach()),
        weight.index_select(0, index) * present,
    )

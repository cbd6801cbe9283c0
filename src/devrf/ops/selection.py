"""The samples of a list whose colour is needed, in a list of their own.

Padding of the new list repeats other places of the old one: it has any ray and position and no
weight, and nothing gets a gradient through it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from devrf.ops.dispatch import triton_runs
from devrf.ops.search import PackedSamples, select


class ListedSubset(NamedTuple):
    """Some of the samples of a list, in a list of length K.

    Attributes:
        first: (R + 1,) int64, as in :class:`~devrf.ops.search.PackedSamples`, for the new list.
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


def select_listed(
    found: PackedSamples, canonical: Tensor, weight: Tensor, capacity: int
) -> ListedSubset:
    """The significant samples of a list, without waiting for the device.

    Args:
        found: C samples.
        canonical: (C, 3) their canonical positions.
        weight: (C,) their weights.
        capacity: K ≤ C, the length of the new list; samples that do not fit are dropped.

    Returns:
        The new list, differentiable once in ``canonical`` and ``weight``.
    """
    rays = len(found.first) - 1
    floats = found.distance, found.points, canonical, weight
    if capacity <= len(found.ray) and triton_runs(*floats):
        from devrf.ops.kernels.selection import SelectListed

        return ListedSubset(
            *SelectListed.apply(  # type: ignore[no-untyped-call]
                canonical.contiguous(), weight.contiguous(), found, capacity
            )
        )
    chosen = select(found.significant, found.first, capacity)
    place = torch.arange(capacity, device=chosen.index.device)
    present = place < chosen.first[-1]
    taken = canonical.index_select(0, chosen.index)
    return ListedSubset(
        chosen.first,
        chosen.total,
        torch.where(present, found.ray.index_select(0, chosen.index), place % max(rays, 1)),
        found.distance.index_select(0, chosen.index),
        found.points.index_select(0, chosen.index),
        present,
        torch.where(present[:, None], taken, taken.detach()),
        weight.index_select(0, chosen.index) * present,
    )

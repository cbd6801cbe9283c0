"""A list's significant samples in a list of their own: a thread for each place of the first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.ops.kernels.cells import load_vectors, store_vectors
from devrf.ops.kernels.launch import launch

if TYPE_CHECKING:
    from devrf.ops.search import PackedSamples

BLOCK = 1024


class SelectListed(torch.autograd.Function):
    """The tensors of devrf.ops.selection.select_listed's result."""

    @staticmethod
    def forward(
        ctx: Any, canonical: Tensor, weight: Tensor, found: PackedSamples, capacity: int
    ) -> tuple[Tensor, ...]:
        flags = found.significant.contiguous()
        places, rays, running = len(flags), len(found.first) - 1, flags.cumsum(0)
        first, ray = torch.empty_like(found.first), found.ray.new_empty(capacity)
        distance, points = weight.new_empty(capacity), canonical.new_empty(capacity, 3)
        present = flags.new_empty(capacity)
        into_canonical, into_weight = torch.empty_like(points), torch.empty_like(distance)
        launch(
            select_kernel,
            triton.cdiv(max(places, rays + 1), BLOCK),
            weight,
            *(flags.view(torch.uint8), running, found.first.contiguous()),
            *(found.ray.contiguous(), found.distance.contiguous(), found.points.contiguous()),
            *(canonical, weight, first, ray, distance, points, present.view(torch.uint8)),
            *(into_canonical, into_weight, places, rays, capacity),
            BLOCK=BLOCK,
        )
        total = running[-1]
        ctx.save_for_backward(flags, running)
        ctx.set_materialize_grads(False)
        known = (first, total, ray, distance, points, present)
        moves = ctx.needs_input_grad[0]
        ctx.mark_non_differentiable(*known, *(() if moves else (into_canonical,)))
        return *known, into_canonical, into_weight

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        flags, running = ctx.saved_tensors
        *_, to_canonical, to_weight = upstream
        given = [None if one is None else one.contiguous() for one in (to_canonical, to_weight)]
        into = [None if one is None else one.new_empty(len(flags), *one.shape[1:]) for one in given]
        launch(
            select_backward_kernel,
            triton.cdiv(len(flags), BLOCK),
            flags,
            *(flags.view(torch.uint8), running),
            # Any pointer where there is no gradient.
            *(running if one is None else one for one in (*given, *into)),
            *(len(flags), max(0 if one is None else len(one) for one in given)),
            HAS_CANONICAL=to_canonical is not None,
            HAS_WEIGHT=to_weight is not None,
            BLOCK=BLOCK,
        )
        return *into, None, None


@triton.jit(do_not_specialize=["places", "count", "capacity"])
def select_kernel(
    flags,
    running,
    first,
    rays,
    distances,
    points,
    canonical,
    weights,
    begin,
    owner,
    reached,
    where,
    present,
    into_canonical,
    into_weight,
    places,
    count,
    capacity,
    BLOCK: tl.constexpr,
):
    """Copies flagged samples to the places that the flags' ``running`` sum gives; the padding.

    A place of the padding copies the sample of the same number, which differ: atomic additions of
    gradients to them do not collide. ``begin`` is where each of the ``count`` rays begins.
    """
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = place < places
    flag = tl.load(flags + place, mask=here, other=0) != 0
    rank = tl.load(running + place, mask=here, other=0) - 1
    kept = here & flag & (rank < capacity)
    empty = (place >= tl.load(running + places - 1)) & (place < capacity)
    ray = tl.load(rays + place, mask=here, other=0)
    distance = tl.load(distances + place, mask=here, other=0.0)
    weight = tl.load(weights + place, mask=kept, other=0.0)
    x, y, z = load_vectors(points, place * 3, here)
    qx, qy, qz = load_vectors(canonical, place * 3, here)
    tl.store(owner + rank, ray, mask=kept)
    tl.store(reached + rank, distance, mask=kept)
    store_vectors(where, rank * 3, x, y, z, kept)
    store_vectors(into_canonical, rank * 3, qx, qy, qz, kept)
    tl.store(into_weight + rank, weight, mask=kept)
    tl.store(present + rank, (rank >= 0).to(tl.uint8), mask=kept)
    tl.store(owner + place, place % count, mask=empty)
    tl.store(reached + place, distance, mask=empty)
    store_vectors(where, place * 3, x, y, z, empty)
    store_vectors(into_canonical, place * 3, qx, qy, qz, empty)
    tl.store(into_weight + place, distance * 0.0, mask=empty)
    tl.store(present + place, (place < 0).to(tl.uint8), mask=empty)
    bounds = place <= count
    start = tl.load(first + place, mask=bounds, other=0)
    before = tl.load(running + start - 1, mask=bounds & (start > 0), other=0)
    tl.store(begin + place, tl.minimum(before, capacity), mask=bounds)


@triton.jit(do_not_specialize=["places", "capacity"])
def select_backward_kernel(
    flags,
    running,
    to_canonical,
    to_weight,
    into_canonical,
    into_weight,
    places,
    capacity,
    HAS_CANONICAL: tl.constexpr,
    HAS_WEIGHT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The gradient of each place of the first list: that of the place that took it, or none."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    here = place < places
    flag = tl.load(flags + place, mask=here, other=0) != 0
    rank = tl.load(running + place, mask=here, other=0) - 1
    kept = here & flag & (rank < capacity)
    if HAS_CANONICAL:
        gx, gy, gz = load_vectors(to_canonical, rank * 3, kept)
        store_vectors(into_canonical, place * 3, gx, gy, gz, here)
    if HAS_WEIGHT:
        change = tl.load(to_weight + rank, mask=kept, other=0.0)
        tl.store(into_weight + place, change, mask=here)

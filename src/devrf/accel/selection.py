"""The significant samples of a list, moved to a list of their own: a thread for each place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import BLOCK, blocks, launch, load_vectors, store_vectors


class SelectListed(torch.autograd.Function):
    """As devrf.ops.search.select_listed; ``listed``: ray, distance, points, significant, first."""

    @staticmethod
    def forward(
        ctx: Any, canonical: Tensor, weight: Tensor, listed: Sequence[Tensor], capacity: int
    ) -> tuple[Tensor, ...]:
        rays, distances, points, flags, begin = (tensor.contiguous() for tensor in listed)
        canonical, weight = canonical.contiguous(), weight.contiguous()
        running = flags.cumsum(0)
        first, ray, present = (
            torch.empty_like(begin),
            *(t.new_empty(capacity) for t in (rays, flags)),
        )
        distance, where = weight.new_empty(capacity), points.new_empty(capacity, 3)
        into_canonical, into_weight = torch.empty_like(where), torch.empty_like(distance)
        launch(
            select_kernel,
            blocks(max(len(flags), len(begin))),
            *(flags.view(torch.uint8), running, begin, rays, distances, points, canonical, weight),
            *(first, ray, distance, where, present.view(torch.uint8), into_canonical, into_weight),
            *(len(flags), len(begin) - 1, capacity),
        )
        ctx.save_for_backward(flags, running)
        ctx.set_materialize_grads(False)
        known = (first, running[-1], ray, distance, where, present)
        moves = ctx.needs_input_grad[0]
        ctx.mark_non_differentiable(*known, *(() if moves else (into_canonical,)))
        return *known, into_canonical, into_weight

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        flags, running = ctx.saved_tensors
        gradients = [None if up is None else up.contiguous() for up in upstream[-2:]]
        into = [None if up is None else up.new_empty(len(flags), *up.shape[1:]) for up in gradients]
        launch(
            select_backward_kernel,
            blocks(len(flags)),
            *(flags.view(torch.uint8), running),
            # Any pointer where there is no gradient.
            *(running if tensor is None else tensor for tensor in (*gradients, *into)),
            *(len(flags), max(0 if up is None else len(up) for up in gradients)),
            HAS_CANONICAL=gradients[0] is not None,
            HAS_WEIGHT=gradients[1] is not None,
        )
        return *into, None, None


select_listed = SelectListed.apply


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
):
    """Copies flagged samples to the places that the flags' ``running`` sum gives; the padding.

    A place of the padding copies the sample of the same number, which differ: atomic additions of
    gradients to them do not collide. ``begin`` is where each of the ``count`` rays begins.
    """
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = place < places
    flag = tl.load(flags + place, mask=mask, other=0) != 0
    rank = tl.load(running + place, mask=mask, other=0) - 1
    selected = mask & flag & (rank < capacity)
    empty = (place >= tl.load(running + places - 1)) & (place < capacity)
    ray = tl.load(rays + place, mask=mask, other=0)
    distance = tl.load(distances + place, mask=mask, other=0.0)
    weight = tl.load(weights + place, mask=selected, other=0.0)
    x, y, z = load_vectors(points, place * 3, mask)
    qx, qy, qz = load_vectors(canonical, place * 3, mask)
    tl.store(owner + rank, ray, mask=selected)
    tl.store(reached + rank, distance, mask=selected)
    store_vectors(where, rank * 3, x, y, z, selected)
    store_vectors(into_canonical, rank * 3, qx, qy, qz, selected)
    tl.store(into_weight + rank, weight, mask=selected)
    tl.store(present + rank, (rank >= 0).to(tl.uint8), mask=selected)
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
):
    """The gradient of each place of the first list: that of the place that took it, or none."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = place < places
    flag = tl.load(flags + place, mask=mask, other=0) != 0
    rank = tl.load(running + place, mask=mask, other=0) - 1
    selected = mask & flag & (rank < capacity)
    if HAS_CANONICAL:
        gx, gy, gz = load_vectors(to_canonical, rank * 3, selected)
        store_vectors(into_canonical, place * 3, gx, gy, gz, mask)
    if HAS_WEIGHT:
        change = tl.load(to_weight + rank, mask=selected, other=0.0)
        tl.store(into_weight + place, change, mask=mask)

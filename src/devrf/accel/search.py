"""The search for visible samples: one program marches along one ray.

The first kernel tests a ray's samples, 32 at a time, until the ray ends or its transmittance falls
below the threshold. It writes a byte for each sample and a count for each ray. The counts' running
sum is where each ray's samples end; the second kernel writes them there, and the padding.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from devrf.accel.blocks import (
    LANES,
    PADDING,
    blocks,
    displaced,
    grid_coordinate,
    launch,
    opacity,
    padding_places,
    padding_programs,
    scalar_at,
    softplus,
    store_vectors,
)


def find_samples(
    rays: tuple[Tensor, Tensor, Tensor, Tensor],
    mask: Tensor,
    density: Tensor,
    slices: Sequence[Tensor],
    axes: tuple[Tensor, Tensor, Tensor],
    numbers: tuple[float, ...],
    longest: int,
    capacity: int,
) -> tuple[Tensor, ...]:
    """As devrf.ops.search.find_samples: ray, distance, points, significant, first, total.

    ``rays``: origins, directions, entry and count; ``axes``: of the mask, of the slices and of the
    density; ``numbers``: step, weight of the second slice, shift, delta, and the thresholds.
    """
    along = [tensor.contiguous() for tensor in rays]
    origins, density = along[0], density.contiguous()
    # The kernel takes two slices; the density stands in for missing ones, which are not read.
    before, after = (frame.contiguous() for frame in ([*slices, density, density])[:2])
    count, stride = len(origins), blocks(longest, LANES.value) * LANES.value
    marks = origins.new_empty(count, stride, dtype=torch.uint8)
    # As wide as their running sum: no cast before it.
    visible = origins.new_empty(count, dtype=torch.int64)
    reached = origins.new_empty(count, dtype=torch.int32)
    launch(
        march_kernel,
        count,
        *(*along, mask.contiguous().view(torch.uint8), density, before, after, *axes),
        *(marks, visible, reached, longest, stride, *numbers),
        SLICES=len(slices),
        num_warps=1,
    )
    ray, first, total = (visible.new_empty(shape) for shape in (capacity, count + 1, ()))
    distance, points = origins.new_empty(capacity), origins.new_empty(capacity, 3)
    significant = marks.new_empty(capacity)
    launch(
        list_kernel,
        # One at least behind the rays, for the total.
        count + max(1, padding_programs(capacity)),
        *(*along[:3], marks, reached, visible.cumsum(0), ray, distance, points, significant),
        *(first, total, count, stride, capacity, numbers[0]),
        num_warps=1,
    )
    return ray, distance, points, significant.view(torch.bool), first, total


@triton.jit
def vector(vectors, number):
    """The components of one vector."""
    at = vectors + number * 3
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)


@triton.jit
def nearest(coordinate, points):
    """The nearest grid point along an axis, halves to the even one; −1 or ``points`` outside.

    NaN is outside.
    """
    coordinate = tl.where(coordinate > -1.0, tl.minimum(coordinate, points * 1.0), -1.0)
    low = tl.floor(coordinate)
    number = low.to(tl.int32)
    above = coordinate - low
    up = (above > 0.5) | ((above == 0.5) & ((number & 1) == 1))
    return number + up.to(tl.int32)


@triton.jit
def occupied(mask, axes, px, py, pz, inside):
    """Is the grid point nearest to a position on the grid and True?"""
    x = tl.load(axes + 6).to(tl.int32)
    y = tl.load(axes + 7).to(tl.int32)
    z = tl.load(axes + 8).to(tl.int32)
    i = nearest(grid_coordinate(axes, 0, px), x)
    j = nearest(grid_coordinate(axes, 1, py), y)
    k = nearest(grid_coordinate(axes, 2, pz), z)
    inside = inside & (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k >= 0) & (k < z)
    return tl.load(mask + (i * y + j) * z + k, mask=inside, other=0) != 0


@triton.jit(do_not_specialize=["longest", "stride"])
def march_kernel(
    origins,
    directions,
    entry,
    count,
    mask,
    density,
    before,
    after,
    mask_axes,
    slice_axes,
    density_axes,
    marks,
    number_visible,
    reached,
    longest,
    stride,
    step,
    weight,
    shift,
    delta,
    alpha_threshold,
    stop,
    weight_threshold,
    SLICES: tl.constexpr,
):
    """Marks each sample of a ray (0 dropped, 1 kept, 2 significant); counts kept and tested."""
    ray = tl.program_id(0)
    ox, oy, oz = vector(origins, ray)
    dx, dy, dz = vector(directions, ray)
    begin = tl.load(entry + ray)
    samples = tl.minimum(tl.load(count + ray).to(tl.int32), longest)
    into = marks + ray.to(tl.int64) * stride
    lane = tl.arange(0, LANES)
    tested = 0
    number = 0
    depth = 0.0
    while (tested < samples) & (tl.exp(-depth) >= stop):
        sample = tested + lane
        at = begin + step * sample.to(tl.float32)
        px = ox + dx * at
        py = oy + dy * at
        pz = oz + dz * at
        candidate = occupied(mask, mask_axes, px, py, pz, sample < samples)
        mark = tl.zeros((LANES,), dtype=tl.uint8)
        if tl.max(candidate.to(tl.int32), 0) > 0:
            if SLICES > 0:
                px, py, pz = displaced(
                    before, after, weight, slice_axes, px, py, pz, candidate, SLICES
                )
            raw = scalar_at(density, density_axes, px, py, pz, candidate)
            tau = softplus(raw + shift) * delta
            alpha = opacity(tau)
            opaque = candidate & (alpha >= alpha_threshold)
            # Nothing is visible behind exp(−32); a larger sum would cost precision.
            tau = tl.where(opaque, tl.minimum(tau, 32.0), 0.0)
            left = tl.exp(-(depth + tl.cumsum(tau, 0) - tau))
            visible = opaque & (left >= stop)
            significant = visible & (left * alpha >= weight_threshold)
            mark = (visible.to(tl.int32) + significant.to(tl.int32)).to(tl.uint8)
            number += tl.sum(visible.to(tl.int32), 0)
            depth += tl.sum(tau, 0)
        tl.store(into + sample, mark)
        tested += LANES
    tl.store(number_visible + ray, number)
    tl.store(reached + ray, tested)


@triton.jit(do_not_specialize=["count", "stride", "capacity"])
def list_kernel(
    origins,
    directions,
    entry,
    marks,
    reached,
    ends,
    rays,
    distances,
    points,
    significant,
    first,
    total,
    count,
    stride,
    capacity,
    step,
):
    """Writes the kept samples of the ``count`` rays one after another, the padding behind them.

    ``ends`` is the running sum of the rays' numbers of samples.
    """
    ray = tl.program_id(0)
    if ray < count:
        ox, oy, oz = vector(origins, ray)
        dx, dy, dz = vector(directions, ray)
        begin = tl.load(entry + ray)
        end = tl.load(reached + ray)
        free = tl.load(ends + ray - 1, mask=ray > 0, other=0)
        tl.store(first + ray, tl.minimum(free, capacity))
        from_ = marks + ray.to(tl.int64) * stride
        lane = tl.arange(0, LANES)
        tested = 0
        while (tested < end) & (free < capacity):
            sample = tested + lane
            mark = tl.load(from_ + sample).to(tl.int32)
            listed = (mark > 0).to(tl.int32)
            place = free + tl.cumsum(listed, 0) - listed
            fits = (listed > 0) & (place < capacity)
            at = begin + step * sample.to(tl.float32)
            tl.store(rays + place, (lane * 0 + ray).to(tl.int64), mask=fits)
            tl.store(distances + place, at, mask=fits)
            store_vectors(points, place * 3, ox + dx * at, oy + dy * at, oz + dz * at, fits)
            tl.store(significant + place, (mark > 1).to(tl.uint8), mask=fits)
            free += tl.sum(listed, 0)
            tested += LANES
    else:
        used = tl.load(ends + count - 1, mask=count > 0, other=0)
        if ray == count:
            tl.store(total, used)
            tl.store(first + count, tl.minimum(used, capacity))
        place, empty = padding_places(ray - count, used, capacity)
        nothing = tl.zeros((PADDING,), dtype=tl.float32)
        tl.store(rays + place, (place * 0 + count).to(tl.int64), mask=empty)
        tl.store(distances + place, nothing, mask=empty)
        store_vectors(points, place * 3, nothing, nothing, nothing, empty)
        tl.store(significant + place, nothing.to(tl.uint8), mask=empty)

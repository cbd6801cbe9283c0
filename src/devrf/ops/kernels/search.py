"""The search for samples that can be seen: one program marches along one ray.

The first kernel looks at a ray's samples, a warp's worth at a time, until the ray ends or nothing
is left of it. It leaves a byte for each sample and a count for each ray. Sums of the counts say
where each ray's samples go; the second kernel writes them there, the third fills the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from devrf.ops.corners import Corners, scales, shape_of
from devrf.ops.kernels.cells import cell, scalar_at
from devrf.ops.kernels.launch import launch
from devrf.ops.kernels.numbers import opacity, softplus
from devrf.ops.kernels.warped_depth import displaced

# Samples that a program looks at together: one for each thread of its only warp.
LANES = 32
PADDING_BLOCK = 1024


def find_samples_on_device(
    origins: Tensor,
    directions: Tensor,
    entry: Tensor,
    count: Tensor,
    mask: Tensor,
    density: Tensor,
    slices: Sequence[Tensor],
    weight: float,
    step: float,
    longest: int,
    capacity: int,
    mask_box: Corners,
    box: Corners,
    shift: float,
    delta: float,
    thresholds: tuple[float, float, float],
) -> tuple[Tensor, ...]:
    """The tensors of devrf.ops.search.find_samples' result, without waiting for the device.

    ``thresholds`` are those of opacity, of transmittance and of weight, in this order.
    """
    device, rays = origins.device, len(origins)
    origins, directions = origins.contiguous(), directions.contiguous()
    entry, density = entry.contiguous(), density.contiguous()
    # The kernel takes two slices; with fewer the density fills in, and is not read as a slice.
    before, after = (frame.contiguous() for frame in ([*slices, density, density])[:2])
    stride = triton.cdiv(longest, LANES) * LANES
    marks = torch.empty(rays, stride, dtype=torch.uint8, device=device)
    kept, reached = torch.empty(2, rays, dtype=torch.int32, device=device)
    ray = torch.empty(capacity, dtype=torch.int64, device=device)
    distance = torch.empty(capacity, dtype=torch.float32, device=device)
    points = torch.empty(capacity, 3, dtype=torch.float32, device=device)
    significant = torch.empty(capacity, dtype=torch.uint8, device=device)
    ends = torch.zeros(rays + 1, dtype=torch.int64, device=device)
    launch(
        march_kernel,
        rays,
        origins,
        origins,
        directions,
        entry,
        count.contiguous(),
        mask.contiguous().view(torch.uint8),
        density,
        before,
        after,
        marks,
        kept,
        reached,
        longest,
        stride,
        step,
        weight,
        shift,
        delta,
        *thresholds,
        *mask_box.low,
        *scales(mask_box, shape_of(mask)),
        *box.low,
        *scales(box, shape_of(before)),
        *scales(box, shape_of(density)),
        *shape_of(mask),
        *shape_of(before),
        *shape_of(density),
        SLICES=len(slices),
        LANES=LANES,
        num_warps=1,
    )
    torch.cumsum(kept, 0, out=ends[1:])
    first = ends.clamp(max=capacity)
    launch(
        list_kernel,
        rays,
        origins,
        origins,
        directions,
        entry,
        marks,
        reached,
        first,
        ray,
        distance,
        points,
        significant,
        stride,
        capacity,
        step,
        LANES=LANES,
        num_warps=1,
    )
    launch(
        pad_kernel,
        triton.cdiv(capacity, PADDING_BLOCK),
        origins,
        first,
        ray,
        distance,
        points,
        significant,
        rays,
        capacity,
        BLOCK=PADDING_BLOCK,
    )
    total = ends[-1]
    overflow = (total > capacity) | (count > longest).any()
    return ray, distance, points, significant.view(torch.bool), first, total, overflow


@triton.jit
def nearest(coordinate, points):
    """The nearest grid point along an axis, halves to the even one; −1 or ``points`` outside.

    One that is no number is outside.
    """
    coordinate = tl.where(coordinate > -1.0, tl.minimum(coordinate, points * 1.0), -1.0)
    low = tl.floor(coordinate)
    number = low.to(tl.int32)
    above = coordinate - low
    up = (above > 0.5) | ((above == 0.5) & ((number & 1) == 1))
    return number + up.to(tl.int32)


@triton.jit
def occupied(mask, cx, cy, cz, x, y, z, here):
    """Is the nearest grid point on the grid and True?"""
    i = nearest(cx, x)
    j = nearest(cy, y)
    k = nearest(cz, z)
    here = here & (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k >= 0) & (k < z)
    return tl.load(mask + (i * y + j) * z + k, mask=here, other=0) != 0


@triton.jit(
    do_not_specialize=[
        "longest",
        "stride",
        "mask_x",
        "mask_y",
        "mask_z",
        "slice_x",
        "slice_y",
        "slice_z",
        "density_x",
        "density_y",
        "density_z",
    ]
)
def march_kernel(
    origins,
    directions,
    entry,
    count,
    mask,
    density,
    before,
    after,
    marks,
    kept,
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
    mask_low_x,
    mask_low_y,
    mask_low_z,
    mask_scale_x,
    mask_scale_y,
    mask_scale_z,
    low_x,
    low_y,
    low_z,
    slice_scale_x,
    slice_scale_y,
    slice_scale_z,
    density_scale_x,
    density_scale_y,
    density_scale_z,
    mask_x,
    mask_y,
    mask_z,
    slice_x,
    slice_y,
    slice_z,
    density_x,
    density_y,
    density_z,
    SLICES: tl.constexpr,
    LANES: tl.constexpr,
):
    """Marks each sample of a ray (0 dropped, 1 kept, 2 significant); counts kept and looked at."""
    ray = tl.program_id(0)
    ox = tl.load(origins + ray * 3)
    oy = tl.load(origins + ray * 3 + 1)
    oz = tl.load(origins + ray * 3 + 2)
    dx = tl.load(directions + ray * 3)
    dy = tl.load(directions + ray * 3 + 1)
    dz = tl.load(directions + ray * 3 + 2)
    begin = tl.load(entry + ray)
    samples = tl.minimum(tl.load(count + ray).to(tl.int32), longest)
    into = marks + ray.to(tl.int64) * stride
    lane = tl.arange(0, LANES)
    looked = 0
    number = 0
    depth = 0.0
    while (looked < samples) & (tl.exp(-depth) >= stop):
        sample = looked + lane
        at = begin + step * sample.to(tl.float32)
        px = ox + dx * at
        py = oy + dy * at
        pz = oz + dz * at
        there = occupied(
            mask,
            (px - mask_low_x) * mask_scale_x,
            (py - mask_low_y) * mask_scale_y,
            (pz - mask_low_z) * mask_scale_z,
            mask_x,
            mask_y,
            mask_z,
            sample < samples,
        )
        mark = tl.zeros((LANES,), dtype=tl.uint8)
        if tl.max(there.to(tl.int32), 0) > 0:
            if SLICES > 0:
                px, py, pz = displaced(
                    before,
                    after,
                    weight,
                    px,
                    py,
                    pz,
                    (px - low_x) * slice_scale_x,
                    (py - low_y) * slice_scale_y,
                    (pz - low_z) * slice_scale_z,
                    slice_x,
                    slice_y,
                    slice_z,
                    there,
                    SLICES,
                )
            i, fx = cell((px - low_x) * density_scale_x, density_x)
            j, fy = cell((py - low_y) * density_scale_y, density_y)
            k, fz = cell((pz - low_z) * density_scale_z, density_z)
            raw = scalar_at(density, i, j, k, fx, fy, fz, density_y, density_z, there)
            tau = softplus(raw + shift) * delta
            alpha = opacity(tau)
            opaque = there & (alpha >= alpha_threshold)
            # Behind exp(−32) nothing is left; a longer sum would cost the digits of a shorter.
            tau = tl.where(opaque, tl.minimum(tau, 32.0), 0.0)
            left = tl.exp(-(depth + tl.cumsum(tau, 0) - tau))
            seen = opaque & (left >= stop)
            significant = seen & (left * alpha >= weight_threshold)
            mark = (seen.to(tl.int32) + significant.to(tl.int32)).to(tl.uint8)
            number += tl.sum(seen.to(tl.int32), 0)
            depth += tl.sum(tau, 0)
        tl.store(into + sample, mark)
        looked += LANES
    tl.store(kept + ray, number)
    tl.store(reached + ray, looked)


@triton.jit(do_not_specialize=["stride", "capacity"])
def list_kernel(
    origins,
    directions,
    entry,
    marks,
    reached,
    first,
    rays,
    distances,
    points,
    significant,
    stride,
    capacity,
    step,
    LANES: tl.constexpr,
):
    """Writes a ray's marked samples one after another, from ``first`` on."""
    ray = tl.program_id(0)
    ox = tl.load(origins + ray * 3)
    oy = tl.load(origins + ray * 3 + 1)
    oz = tl.load(origins + ray * 3 + 2)
    dx = tl.load(directions + ray * 3)
    dy = tl.load(directions + ray * 3 + 1)
    dz = tl.load(directions + ray * 3 + 2)
    begin = tl.load(entry + ray)
    end = tl.load(reached + ray)
    free = tl.load(first + ray)
    from_ = marks + ray.to(tl.int64) * stride
    lane = tl.arange(0, LANES)
    looked = 0
    while (looked < end) & (free < capacity):
        sample = looked + lane
        mark = tl.load(from_ + sample).to(tl.int32)
        kept = (mark > 0).to(tl.int32)
        place = free + tl.cumsum(kept, 0) - kept
        fits = (kept > 0) & (place < capacity)
        at = begin + step * sample.to(tl.float32)
        tl.store(rays + place, (lane * 0 + ray).to(tl.int64), mask=fits)
        tl.store(distances + place, at, mask=fits)
        tl.store(points + place * 3, ox + dx * at, mask=fits)
        tl.store(points + place * 3 + 1, oy + dy * at, mask=fits)
        tl.store(points + place * 3 + 2, oz + dz * at, mask=fits)
        tl.store(significant + place, (mark > 1).to(tl.uint8), mask=fits)
        free += tl.sum(kept, 0)
        looked += LANES


@triton.jit(do_not_specialize=["count", "capacity"])
def pad_kernel(first, rays, distances, points, significant, count, capacity, BLOCK: tl.constexpr):
    """Fills the places that no sample of the ``count`` rays has taken."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    empty = (place >= tl.load(first + count)) & (place < capacity)
    nothing = tl.zeros((BLOCK,), dtype=tl.float32)
    at = place.to(tl.int64) * 3
    tl.store(rays + place, (place * 0 + count).to(tl.int64), mask=empty)
    tl.store(distances + place, nothing, mask=empty)
    tl.store(points + at, nothing, mask=empty)
    tl.store(points + at + 1, nothing, mask=empty)
    tl.store(points + at + 2, nothing, mask=empty)
    tl.store(significant + place, nothing.to(tl.uint8), mask=empty)

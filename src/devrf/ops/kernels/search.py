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

from devrf.ops.corners import Corners, scales, shape_of
from devrf.ops.kernels.cells import cell, scalar_at, store_vectors
from devrf.ops.kernels.launch import launch
from devrf.ops.kernels.numbers import opacity, softplus
from devrf.ops.kernels.padding import PADDING, padding_places, padding_programs
from devrf.ops.kernels.warped_depth import displaced

# A program is one warp, which tests one sample for each of its threads at a time.
LANES = 32
WARP = {"LANES": LANES, "num_warps": 1}


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
    # The kernel takes two slices; the density stands in for missing ones, which are not read.
    before, after = (frame.contiguous() for frame in ([*slices, density, density])[:2])
    stride = triton.cdiv(longest, LANES) * LANES
    marks = torch.empty(rays, stride, dtype=torch.uint8, device=device)
    # As wide as their running sum: no cast before it.
    kept = torch.empty(rays, dtype=torch.int64, device=device)
    reached = torch.empty(rays, dtype=torch.int32, device=device)
    ray = torch.empty(capacity, dtype=torch.int64, device=device)
    distance = torch.empty(capacity, dtype=torch.float32, device=device)
    points = torch.empty(capacity, 3, dtype=torch.float32, device=device)
    significant = torch.empty(capacity, dtype=torch.uint8, device=device)
    first, total = (torch.empty(n, dtype=torch.int64, device=device) for n in (rays + 1, ()))
    along = (origins, directions, entry)
    shapes = (shape_of(mask), shape_of(before), shape_of(density))
    launch(
        march_kernel,
        rays,
        origins,
        *(*along, count.contiguous()),
        *(mask.contiguous().view(torch.uint8), density, before, after),
        *(marks, kept, reached, longest, stride),
        *(step, weight, shift, delta, *thresholds),
        *(*mask_box.low, *scales(mask_box, shapes[0])),
        *(*box.low, *scales(box, shapes[1]), *scales(box, shapes[2])),
        *(points for shape in shapes for points in shape),
        SLICES=len(slices),
        **WARP,
    )
    found = (ray, distance, points, significant, first, total)
    launch(
        list_kernel,
        # One at least behind the rays, for the total.
        rays + max(1, padding_programs(capacity)),
        origins,
        *(*along, marks, reached, kept.cumsum(0), *found, rays, stride, capacity, step),
        PADDING=PADDING,
        **WARP,
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
def occupied(mask, cx, cy, cz, x, y, z, here):
    """Is the nearest grid point on the grid and True?"""
    i = nearest(cx, x)
    j = nearest(cy, y)
    k = nearest(cz, z)
    here = here & (i >= 0) & (i < x) & (j >= 0) & (j < y) & (k >= 0) & (k < z)
    return tl.load(mask + (i * y + j) * z + k, mask=here, other=0) != 0


SIZES = [f"{grid}_{axis}" for grid in ("mask", "slice", "density") for axis in "xyz"]


@triton.jit(do_not_specialize=["longest", "stride", *SIZES])
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
            # Nothing is visible behind exp(−32); a larger sum would cost precision.
            tau = tl.where(opaque, tl.minimum(tau, 32.0), 0.0)
            left = tl.exp(-(depth + tl.cumsum(tau, 0) - tau))
            seen = opaque & (left >= stop)
            significant = seen & (left * alpha >= weight_threshold)
            mark = (seen.to(tl.int32) + significant.to(tl.int32)).to(tl.uint8)
            number += tl.sum(seen.to(tl.int32), 0)
            depth += tl.sum(tau, 0)
        tl.store(into + sample, mark)
        tested += LANES
    tl.store(kept + ray, number)
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
    LANES: tl.constexpr,
    PADDING: tl.constexpr,
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
            kept = (mark > 0).to(tl.int32)
            place = free + tl.cumsum(kept, 0) - kept
            fits = (kept > 0) & (place < capacity)
            at = begin + step * sample.to(tl.float32)
            tl.store(rays + place, (lane * 0 + ray).to(tl.int64), mask=fits)
            tl.store(distances + place, at, mask=fits)
            store_vectors(points, place * 3, ox + dx * at, oy + dy * at, oz + dz * at, fits)
            tl.store(significant + place, (mark > 1).to(tl.uint8), mask=fits)
            free += tl.sum(kept, 0)
            tested += LANES
    else:
        used = tl.load(ends + count - 1, mask=count > 0, other=0)
        if ray == count:
            tl.store(total, used)
            tl.store(first + count, tl.minimum(used, capacity))
        place, empty = padding_places(ray - count, used, capacity, PADDING)
        nothing = tl.zeros((PADDING,), dtype=tl.float32)
        tl.store(rays + place, (place * 0 + count).to(tl.int64), mask=empty)
        tl.store(distances + place, nothing, mask=empty)
        store_vectors(points, place * 3, nothing, nothing, nothing, empty)
        tl.store(significant + place, nothing.to(tl.uint8), mask=empty)

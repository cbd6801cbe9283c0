"""Cycle and flow: a thread for each sample; the sums over samples in a second launch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import (
    BLOCK,
    blocks,
    cell,
    corner_row,
    corner_slopes,
    displaced,
    gradient_target,
    launch,
    load_vectors,
    pace,
    scatter_vectors,
    store_vectors,
)

# Numbers that the one program of the second launch reads at a time.
AT_ONCE: tl.constexpr = tl.constexpr(1024)
# As in devrf.ops.motion.
NEAREST: tl.constexpr = tl.constexpr(1e-8)
BEFORE_INFINITY: tl.constexpr = tl.constexpr(1e-6)


class Motion(torch.autograd.Function):
    """As devrf.ops.motion.motion_sum: the weighted sum, and both terms."""

    @staticmethod
    def forward(
        ctx: Any,
        canonical: Tensor,
        weight: Tensor,
        forward: Tensor,
        known: Sequence[Tensor],
        earlier: Sequence[Tensor] | None,
        weights: Sequence[float],
        over_samples: bool,
        ndc: tuple[float, float, float] | None,
        accumulated: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """The sum and the terms; an argument that is None is not there.

        ``known``: points, ray and present of the samples; Δ_f of the frame before; axes of both.
        ``earlier``: fields of ``SeenEarlier``. ``accumulated``: the gradient that ``forward`` has.
        """
        # Any pointers stand in for what was not seen.
        valid = known[2] if earlier is None else earlier[1]
        tensors = tuple(
            (tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor).contiguous()
            for tensor in (canonical, weight, forward, *known, *(earlier or [valid] * 8))
        )
        ctx.kinds = {"FLOW": earlier is not None, "NDC": ndc is not None}
        ctx.numbers, ctx.weights, ctx.accumulated = ndc or (1.0, 1.0, 1.0), weights, accumulated
        count, programs = len(canonical), blocks(len(canonical))
        parts, sums = canonical.new_empty(programs, 4), canonical.new_empty(5)
        launch(motion_kernel, programs, *tensors, parts, count, *ctx.numbers, **ctx.kinds)
        launch(
            finish_motion_kernel,
            1,
            *(parts, valid.view(torch.uint8), sums, programs, len(valid), *weights),
            OVER_RAYS=earlier is not None and not over_samples,
        )
        ctx.save_for_backward(*tensors, sums)
        ctx.set_materialize_grads(False)
        terms = sums[:2]
        ctx.mark_non_differentiable(terms)
        return sums[2], terms

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: None) -> tuple[Tensor | None, ...]:
        canonical, weight, forward, *_known, sums = tensors = ctx.saved_tensors
        into, gradient, adds = gradient_target(forward, ctx.needs_input_grad[2], ctx.accumulated)
        moved, changed = torch.empty_like(canonical), torch.empty_like(weight)
        launch(
            motion_backward_kernel,
            blocks(len(canonical)),
            *(*tensors, upstream.contiguous(), moved, changed, into),
            *(len(canonical), *ctx.numbers, *ctx.weights),
            NEEDS_FORWARD=adds,
            **ctx.kinds,
        )
        return moved, changed, gradient, *[None] * 6


motion_sum = Motion.apply


@triton.jit
def to_world(x, y, z, slope_x, slope_y, near, NDC: tl.constexpr):
    """World coordinates, and the NDC depth's gap to infinity."""
    gap = z - 1.0
    if NDC:
        gap = tl.where(gap == 0.0, -BEFORE_INFINITY, gap)
        z = 2.0 * near / gap
        x = -x * z / slope_x
        y = -y * z / slope_y
    return x, y, z, gap


@triton.jit
def local_axis(pose, x, y, z, mask):
    """A camera's own axis, the column at ``pose``, times world coordinates from its centre."""
    along = tl.load(pose, mask=mask, other=0.0) * x
    along += tl.load(pose + 4, mask=mask, other=0.0) * y
    return along + tl.load(pose + 8, mask=mask, other=0.0) * z


@triton.jit
def world_axis(pose, x, y, z, mask):
    """The reverse: a world axis, the row at ``pose``, times coordinates in the camera's axes."""
    along = tl.load(pose, mask=mask, other=0.0) * x
    along += tl.load(pose + 1, mask=mask, other=0.0) * y
    return along + tl.load(pose + 2, mask=mask, other=0.0) * z


@triton.jit
def missed_flow(x, y, z, ray, image, vectors, pixel, previous, poses, focal, center, mask):
    """Induced minus observed flow of world points, and what their gradient needs."""
    camera = tl.load(previous + tl.load(image + ray, mask=mask, other=0), mask=mask, other=0)
    pose = poses + camera * 12
    x -= tl.load(pose + 3, mask=mask, other=0.0)
    y -= tl.load(pose + 7, mask=mask, other=0.0)
    z -= tl.load(pose + 11, mask=mask, other=0.0)
    right = local_axis(pose, x, y, z, mask)
    up = local_axis(pose + 1, x, y, z, mask)
    depth = -local_axis(pose + 2, x, y, z, mask)
    depth = tl.where(tl.abs(depth) < NEAREST, NEAREST, depth)
    focal_x = tl.load(focal + camera * 2, mask=mask, other=0.0)
    focal_y = tl.load(focal + camera * 2 + 1, mask=mask, other=0.0)
    across = focal_x * right / depth + tl.load(center + camera * 2, mask=mask, other=0.0)
    down = -focal_y * up / depth + tl.load(center + camera * 2 + 1, mask=mask, other=0.0)
    across -= tl.load(pixel + ray * 2, mask=mask, other=0.0)
    across -= tl.load(vectors + ray * 2, mask=mask, other=0.0)
    down -= tl.load(pixel + ray * 2 + 1, mask=mask, other=0.0)
    down -= tl.load(vectors + ray * 2 + 1, mask=mask, other=0.0)
    return across, down, pose, right, up, depth, focal_x, focal_y


@triton.jit
def pulled(grid, axes, px, py, pz, gx, gy, gz, mask):
    """Slopes, per unit of length, of the values of a grid (X, Y, Z, 3) times (gx, gy, gz)."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    over_x = fx * 0.0
    over_y = fx * 0.0
    over_z = fx * 0.0
    for corner in tl.static_range(8):
        dx, dy, dz = load_vectors(grid, corner_row(first, along_x, along_y, corner) * 3, mask)
        agreed = dx * gx + dy * gy + dz * gz
        dx, dy, dz = corner_slopes(agreed, fx, fy, fz, corner)
        over_x += dx
        over_y += dy
        over_z += dz
    return over_x * pace(axes, 0, px), over_y * pace(axes, 1, py), over_z * pace(axes, 2, pz)


@triton.jit(do_not_specialize=["count"])
def motion_kernel(
    canonical,
    weight,
    forward,
    points,
    ray,
    present,
    before,
    axes,
    vectors,
    valid,
    pixel,
    image,
    previous,
    poses,
    focal,
    center,
    parts,
    count,
    slope_x,
    slope_y,
    near,
    FLOW: tl.constexpr,
    NDC: tl.constexpr,
):
    """A block's sums of both terms, and of the samples that each is over."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = (place < count) & (tl.load(present + place, mask=place < count, other=0) != 0)
    at = place.to(tl.int64) * 3
    qx, qy, qz = load_vectors(canonical, at, mask)
    mx, my, mz = displaced(forward, forward, 0.0, axes, qx, qy, qz, mask, SLICES=1)
    px, py, pz = load_vectors(points, at, mask)
    mx -= px
    my -= py
    mz -= pz
    missed = tl.where(mask, mx * mx + my * my + mz * mz, 0.0)
    part = parts + tl.program_id(0) * 4
    tl.store(part, 0.5 * tl.sum(missed, 0))
    tl.store(part + 1, tl.sum(mask.to(tl.float32), 0))
    error = 0.0 * qx
    on = mask
    if FLOW:
        sample_ray = tl.load(ray + place, mask=mask, other=0)
        on = mask & (tl.load(valid + sample_ray, mask=mask, other=0) != 0)
        mx, my, mz = displaced(before, before, 0.0, axes, qx, qy, qz, on, SLICES=1)
        mx, my, mz, _ = to_world(mx, my, mz, slope_x, slope_y, near, NDC)
        across, down, _, _, _, _, _, _ = missed_flow(
            mx, my, mz, sample_ray, image, vectors, pixel, previous, poses, focal, center, on
        )
        error = tl.load(weight + place, mask=on, other=0.0) * (tl.abs(across) + tl.abs(down))
    tl.store(part + 2, tl.sum(tl.where(on, error, 0.0), 0))
    tl.store(part + 3, tl.sum(on.to(tl.float32), 0))


@triton.jit(do_not_specialize=["programs", "rays"])
def finish_motion_kernel(
    parts, valid, sums, programs, rays, of_cycle, of_flow, OVER_RAYS: tl.constexpr
):
    """Cycle, flow, their weighted sum; and one by what each is divided by."""
    lane = tl.arange(0, AT_ONCE)
    cycle = tl.zeros((AT_ONCE,), dtype=tl.float32)
    samples = tl.zeros((AT_ONCE,), dtype=tl.float32)
    flow = tl.zeros((AT_ONCE,), dtype=tl.float32)
    counted = tl.zeros((AT_ONCE,), dtype=tl.float32)
    start = 0
    while start < programs:
        part = parts + (start + lane) * 4
        mask = start + lane < programs
        cycle += tl.load(part, mask=mask, other=0.0)
        samples += tl.load(part + 1, mask=mask, other=0.0)
        flow += tl.load(part + 2, mask=mask, other=0.0)
        counted += 2.0 * tl.load(part + 3, mask=mask, other=0.0)
        start += AT_ONCE
    if OVER_RAYS:
        counted = tl.zeros((AT_ONCE,), dtype=tl.float32)
        start = 0
        while start < rays:
            known = tl.load(valid + start + lane, mask=start + lane < rays, other=0)
            counted += (known != 0).to(tl.float32)
            start += AT_ONCE
    by_cycle = 1.0 / tl.maximum(tl.sum(samples, 0), 1.0)
    by_flow = 1.0 / tl.maximum(tl.sum(counted, 0), 1.0)
    mean_cycle = tl.sum(cycle, 0) * by_cycle
    mean_flow = tl.sum(flow, 0) * by_flow
    tl.store(sums, mean_cycle)
    tl.store(sums + 1, mean_flow)
    tl.store(sums + 2, of_cycle * mean_cycle + of_flow * mean_flow)
    tl.store(sums + 3, by_cycle)
    tl.store(sums + 4, by_flow)


@triton.jit(do_not_specialize=["count"])
def motion_backward_kernel(
    canonical,
    weight,
    forward,
    points,
    ray,
    present,
    before,
    axes,
    vectors,
    valid,
    pixel,
    image,
    previous,
    poses,
    focal,
    center,
    sums,
    upstream,
    into_canonical,
    into_weight,
    into_forward,
    count,
    slope_x,
    slope_y,
    near,
    of_cycle,
    of_flow,
    NEEDS_FORWARD: tl.constexpr,
    FLOW: tl.constexpr,
    NDC: tl.constexpr,
):
    """Gradients of q and w, and of Δ_f, which are scattered to its grid."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    listed = place < count
    mask = listed & (tl.load(present + place, mask=listed, other=0) != 0)
    at = place.to(tl.int64) * 3
    qx, qy, qz = load_vectors(canonical, at, mask)
    gx, gy, gz = displaced(forward, forward, 0.0, axes, qx, qy, qz, mask, SLICES=1)
    px, py, pz = load_vectors(points, at, mask)
    slope = tl.where(mask, tl.load(upstream) * of_cycle * tl.load(sums + 3), 0.0)
    gx = slope * (gx - px)
    gy = slope * (gy - py)
    gz = slope * (gz - pz)
    if NEEDS_FORWARD:
        scatter_vectors(into_forward, 1.0, axes, qx, qy, qz, gx, gy, gz, mask)
    over_x, over_y, over_z = pulled(forward, axes, qx, qy, qz, gx, gy, gz, mask)
    gx += over_x
    gy += over_y
    gz += over_z
    change = 0.0 * qx
    if FLOW:
        sample_ray = tl.load(ray + place, mask=mask, other=0)
        on = mask & (tl.load(valid + sample_ray, mask=mask, other=0) != 0)
        mx, my, mz = displaced(before, before, 0.0, axes, qx, qy, qz, on, SLICES=1)
        wx, wy, wz, gap = to_world(mx, my, mz, slope_x, slope_y, near, NDC)
        across, down, pose, right, up, depth, focal_x, focal_y = missed_flow(
            wx, wy, wz, sample_ray, image, vectors, pixel, previous, poses, focal, center, on
        )
        slope = tl.where(on, tl.load(upstream) * of_flow * tl.load(sums + 4), 0.0)
        change = slope * (tl.abs(across) + tl.abs(down))
        slope *= tl.load(weight + place, mask=on, other=0.0)
        to_right = slope * sign(across) * focal_x / depth
        to_up = -slope * sign(down) * focal_y / depth
        # ∂/∂z of the camera's own axis, −depth; none where the depth was replaced.
        to_back = tl.where(depth == NEAREST, 0.0, (to_right * right + to_up * up) / depth)
        ux = world_axis(pose, to_right, to_up, to_back, on)
        uy = world_axis(pose + 4, to_right, to_up, to_back, on)
        uz = world_axis(pose + 8, to_right, to_up, to_back, on)
        if NDC:
            far = tl.where(mz == 1.0, 0.0, -wz / gap)
            uz = far * (uz - mx / slope_x * ux - my / slope_y * uy)
            ux = -wz / slope_x * ux
            uy = -wz / slope_y * uy
        over_x, over_y, over_z = pulled(before, axes, qx, qy, qz, ux, uy, uz, on)
        gx += tl.where(on, ux + over_x, 0.0)
        gy += tl.where(on, uy + over_y, 0.0)
        gz += tl.where(on, uz + over_z, 0.0)
    store_vectors(into_canonical, at, gx, gy, gz, listed)
    tl.store(into_weight + place, change, mask=listed)


@triton.jit
def sign(x):
    """−1, 0 or 1."""
    return tl.where(x > 0.0, 1.0, tl.where(x < 0.0, -1.0, 0.0))

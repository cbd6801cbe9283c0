"""Warp, density and optical depth of points in one pass; their gradients in another.

A thread processes a point: the three components of a displacement lie in one sector of memory, and
neighbouring points of a ray find the grid rows that they share in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.ops.corners import Corners, scales, shape_of
from devrf.ops.kernels.cells import (
    cell,
    corner_row,
    corner_weight,
    inside,
    load_vectors,
    scalar_at,
    scalar_slope,
    store_vectors,
)
from devrf.ops.kernels.launch import launch
from devrf.ops.kernels.numbers import sigmoid, softplus

BLOCK = 128


def warped_depth_in_one_pass(
    points: Tensor,
    density: Tensor,
    slices: Sequence[Tensor],
    weight: float,
    box: Corners,
    shift: float,
    delta: float,
    density_gradient: Tensor | None,
    slice_gradients: Sequence[Tensor | None],
) -> tuple[Tensor, Tensor]:
    """As devrf.ops.warped_depth.warped_depth; a gradient buffer for each slice, or None."""
    density = density.contiguous()
    # The kernel takes two slices; the density stands in for missing ones, which are not read.
    before, after = (frame.contiguous() for frame in ([*slices, density, density])[:2])
    buffers = (density_gradient, *([*slice_gradients, None, None])[:2])
    numbers = (
        weight,
        shift,
        delta,
        *box.low,
        *scales(box, shape_of(before)),
        *scales(box, shape_of(density)),
        *shape_of(before),
        *shape_of(density),
    )
    q, tau = WarpedDepth.apply(
        points.detach().contiguous(), density, before, after, len(slices), numbers, buffers
    )
    return q, tau


class WarpedDepth(torch.autograd.Function):
    """As devrf.ops.warped_depth.warped_depth."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        density: Tensor,
        before: Tensor,
        after: Tensor,
        slices: int,
        numbers: tuple[float, ...],
        buffers: tuple[Tensor | None, ...],
    ) -> tuple[Tensor, Tensor]:
        count = len(points)
        warped, tau = torch.empty_like(points), points.new_empty(count)
        launch(
            warped_depth_kernel,
            triton.cdiv(count, BLOCK),
            points,
            *(points, density, before, after, warped, tau, count, *numbers),
            SLICES=slices,
            BLOCK=BLOCK,
        )
        ctx.save_for_backward(points, density, before, after, warped)
        ctx.slices, ctx.numbers, ctx.buffers = slices, numbers, buffers
        ctx.set_materialize_grads(False)
        if not any(ctx.needs_input_grad[2 : 2 + slices]):
            # Points get no gradient: without slices nothing that is looked up at q need find one.
            ctx.mark_non_differentiable(warped)
        return warped, tau

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, warped_gradient: Tensor | None, tau_gradient: Tensor | None
    ) -> tuple[Any, ...]:
        points, density, before, after, warped = ctx.saved_tensors
        used = (True, ctx.slices > 0, ctx.slices > 1)
        needs, gradients, into = [], [], []
        for grid, asked, buffer, is_used in zip(
            (density, before, after), ctx.needs_input_grad[1:4], ctx.buffers, used, strict=True
        ):
            need = is_used and (asked or buffer is not None)
            own = torch.zeros_like(grid) if need and buffer is None else None
            needs.append(need)
            gradients.append(own)
            # Any pointer where no gradient is needed.
            into.append(grid if not need else buffer if own is None else own)
        if tau_gradient is None:
            tau_gradient = points.new_zeros(len(points))
        if warped_gradient is None:
            # The kernel reads it for slices alone; any pointer serves where there are none.
            warped_gradient = torch.zeros_like(points) if any(needs[1:]) else points
        upstream = (warped_gradient.contiguous(), tau_gradient.contiguous())
        launch(
            warped_depth_backward_kernel,
            triton.cdiv(len(points), BLOCK),
            points,
            *(points, density, warped, *upstream),
            *(*into, len(points), *ctx.numbers),
            NEEDS_DENSITY=needs[0],
            NEEDS_BEFORE=needs[1],
            NEEDS_AFTER=needs[2],
            TWO=ctx.slices > 1,
            BLOCK=BLOCK,
        )
        return None, *gradients, None, None, None


@triton.jit
def displaced(before, after, weight, px, py, pz, cx, cy, cz, x, y, z, here, SLICES: tl.constexpr):
    """Points moved by one slice, or by two that are blended; coordinates in the slices' grid."""
    i, fx = cell(cx, x)
    j, fy = cell(cy, y)
    k, fz = cell(cz, z)
    for corner in tl.static_range(8):
        place = corner_row(i, j, k, y, z, corner) * 3
        part = corner_weight(fx, fy, fz, corner)
        dx, dy, dz = load_vectors(before, place, here)
        if SLICES == 2:
            ex, ey, ez = load_vectors(after, place, here)
            dx += weight * (ex - dx)
            dy += weight * (ey - dy)
            dz += weight * (ez - dz)
        px += part * dx
        py += part * dy
        pz += part * dz
    return px, py, pz


_SIZES = ["count", "slice_x", "slice_y", "slice_z", "density_x", "density_y", "density_z"]


@triton.jit(do_not_specialize=_SIZES)
def warped_depth_kernel(
    points,
    density,
    before,
    after,
    warped,
    tau,
    count,
    weight,
    shift,
    delta,
    low_x,
    low_y,
    low_z,
    slice_scale_x,
    slice_scale_y,
    slice_scale_z,
    density_scale_x,
    density_scale_y,
    density_scale_z,
    slice_x,
    slice_y,
    slice_z,
    density_x,
    density_y,
    density_z,
    SLICES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """q = x + Δ(x), τ = softplus(v(q) + b)·δ."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    at = point.to(tl.int64) * 3
    qx, qy, qz = load_vectors(points, at, here)
    if SLICES > 0:
        qx, qy, qz = displaced(
            before,
            after,
            weight,
            qx,
            qy,
            qz,
            (qx - low_x) * slice_scale_x,
            (qy - low_y) * slice_scale_y,
            (qz - low_z) * slice_scale_z,
            slice_x,
            slice_y,
            slice_z,
            here,
            SLICES,
        )
    store_vectors(warped, at, qx, qy, qz, here)
    i, fx = cell((qx - low_x) * density_scale_x, density_x)
    j, fy = cell((qy - low_y) * density_scale_y, density_y)
    k, fz = cell((qz - low_z) * density_scale_z, density_z)
    raw = scalar_at(density, i, j, k, fx, fy, fz, density_y, density_z, here)
    tl.store(tau + point, softplus(raw + shift) * delta, mask=here)


@triton.jit(do_not_specialize=_SIZES)
def warped_depth_backward_kernel(
    points,
    density,
    warped,
    warped_gradient,
    tau_gradient,
    density_into,
    before_into,
    after_into,
    count,
    weight,
    shift,
    delta,
    low_x,
    low_y,
    low_z,
    slice_scale_x,
    slice_scale_y,
    slice_scale_z,
    density_scale_x,
    density_scale_y,
    density_scale_z,
    slice_x,
    slice_y,
    slice_z,
    density_x,
    density_y,
    density_z,
    NEEDS_DENSITY: tl.constexpr,
    NEEDS_BEFORE: tl.constexpr,
    NEEDS_AFTER: tl.constexpr,
    TWO: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradients of q and τ, scattered to the density grid and to the slices."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    at = point.to(tl.int64) * 3
    qx, qy, qz = load_vectors(warped, at, here)
    cx = (qx - low_x) * density_scale_x
    cy = (qy - low_y) * density_scale_y
    cz = (qz - low_z) * density_scale_z
    i, fx = cell(cx, density_x)
    j, fy = cell(cy, density_y)
    k, fz = cell(cz, density_z)
    raw, along_x, along_y, along_z = scalar_slope(
        density, i, j, k, fx, fy, fz, density_y, density_z, here
    )
    change = tl.load(tau_gradient + point, mask=here, other=0.0) * sigmoid(raw + shift) * delta
    if NEEDS_DENSITY:
        for corner in tl.static_range(8):
            row = corner_row(i, j, k, density_y, density_z, corner)
            part = corner_weight(fx, fy, fz, corner)
            # Padding has no gradient; atomic additions of its zeros would be serialised.
            tl.atomic_add(
                density_into + row, part * change, mask=here & (change != 0.0), sem="relaxed"
            )
    if NEEDS_BEFORE or NEEDS_AFTER:
        gx, gy, gz = load_vectors(warped_gradient, at, here)
        gx += change * along_x * inside(cx, density_x) * density_scale_x
        gy += change * along_y * inside(cy, density_y) * density_scale_y
        gz += change * along_z * inside(cz, density_z) * density_scale_z
        px, py, pz = load_vectors(points, at, here)
        px = (px - low_x) * slice_scale_x
        py = (py - low_y) * slice_scale_y
        pz = (pz - low_z) * slice_scale_z
        if NEEDS_BEFORE:
            own = 1.0 - weight if TWO else 1.0
            scatter(before_into, own, px, py, pz, gx, gy, gz, slice_x, slice_y, slice_z, here)
        if NEEDS_AFTER:
            scatter(after_into, weight, px, py, pz, gx, gy, gz, slice_x, slice_y, slice_z, here)


@triton.jit
def scatter(into, weight, cx, cy, cz, gx, gy, gz, x, y, z, here):
    """Add ``weight`` times the gradients (gx, gy, gz) at grid coordinates to eight rows."""
    i, fx = cell(cx, x)
    j, fy = cell(cy, y)
    k, fz = cell(cz, z)
    gx = gx * weight
    gy = gy * weight
    gz = gz * weight
    here = here & ((gx != 0.0) | (gy != 0.0) | (gz != 0.0))
    for corner in tl.static_range(8):
        place = corner_row(i, j, k, y, z, corner) * 3
        part = corner_weight(fx, fy, fz, corner)
        tl.atomic_add(into + place, part * gx, mask=here, sem="relaxed")
        tl.atomic_add(into + place + 1, part * gy, mask=here, sem="relaxed")
        tl.atomic_add(into + place + 2, part * gz, mask=here, sem="relaxed")

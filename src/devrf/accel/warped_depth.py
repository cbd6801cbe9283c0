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

from devrf.accel.blocks import (
    BLOCK,
    blocks,
    displaced,
    launch,
    load_vectors,
    scalar_and_slopes,
    scalar_at,
    scatter_scalars,
    scatter_vectors,
    sigmoid,
    softplus,
    store_vectors,
)


def warped_depth(
    points: Tensor,
    density: Tensor,
    slices: Sequence[Tensor],
    axes: tuple[Tensor, Tensor],
    numbers: tuple[float, float, float],
    buffers: Sequence[Tensor | None],
) -> tuple[Tensor, Tensor]:
    """As devrf.ops.warped_depth.warped_depth.

    Args:
        points: (M, 3).
        density: raw densities.
        slices: displacements.
        axes: of the slices and of the density.
        numbers: weight of the second slice, shift, delta.
        buffers: gradients that the density and each slice have already, or None.
    """
    density = density.contiguous()
    # The kernel takes two slices; the density stands in for missing ones, which are not read.
    before, after = (frame.contiguous() for frame in ([*slices, density, density])[:2])
    buffers = (*buffers, None, None)[:3]
    given = (points.detach().contiguous(), density, before, after)
    q, tau = WarpedDepth.apply(*given, len(slices), axes, numbers, buffers)
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
        axes: tuple[Tensor, Tensor],
        numbers: tuple[float, float, float],
        buffers: Sequence[Tensor | None],
    ) -> tuple[Tensor, Tensor]:
        count = len(points)
        warped, tau = torch.empty_like(points), points.new_empty(count)
        launch(
            warped_depth_kernel,
            blocks(count),
            points,
            *(points, density, before, after, *axes, warped, tau, count, *numbers),
            SLICES=slices,
        )
        ctx.save_for_backward(points, density, before, after, warped)
        ctx.slices, ctx.axes, ctx.numbers, ctx.buffers = slices, axes, numbers, buffers
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
        launch(
            warped_depth_backward_kernel,
            blocks(len(points)),
            points,
            *(points, density, warped, warped_gradient.contiguous(), tau_gradient.contiguous()),
            *(*into, *ctx.axes, len(points), *ctx.numbers),
            NEEDS_DENSITY=needs[0],
            NEEDS_BEFORE=needs[1],
            NEEDS_AFTER=needs[2],
            TWO=ctx.slices > 1,
        )
        return None, *gradients, None, None, None, None


@triton.jit(do_not_specialize=["count"])
def warped_depth_kernel(
    points,
    density,
    before,
    after,
    slice_axes,
    density_axes,
    warped,
    tau,
    count,
    weight,
    shift,
    delta,
    SLICES: tl.constexpr,
):
    """q = x + Δ(x), τ = softplus(v(q) + b)·δ."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    at = point.to(tl.int64) * 3
    x, y, z = load_vectors(points, at, here)
    if SLICES > 0:
        x, y, z = displaced(before, after, weight, slice_axes, x, y, z, here, SLICES)
    store_vectors(warped, at, x, y, z, here)
    raw = scalar_at(density, density_axes, x, y, z, here)
    tl.store(tau + point, softplus(raw + shift) * delta, mask=here)


@triton.jit(do_not_specialize=["count"])
def warped_depth_backward_kernel(
    points,
    density,
    warped,
    warped_gradient,
    tau_gradient,
    density_into,
    before_into,
    after_into,
    slice_axes,
    density_axes,
    count,
    weight,
    shift,
    delta,
    NEEDS_DENSITY: tl.constexpr,
    NEEDS_BEFORE: tl.constexpr,
    NEEDS_AFTER: tl.constexpr,
    TWO: tl.constexpr,
):
    """Gradients of q and τ, scattered to the density grid and to the slices."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = point < count
    at = point.to(tl.int64) * 3
    x, y, z = load_vectors(warped, at, here)
    raw, over_x, over_y, over_z = scalar_and_slopes(density, density_axes, x, y, z, here)
    change = tl.load(tau_gradient + point, mask=here, other=0.0) * sigmoid(raw + shift) * delta
    if NEEDS_DENSITY:
        scatter_scalars(density_into, density_axes, x, y, z, change, here)
    if NEEDS_BEFORE or NEEDS_AFTER:
        gx, gy, gz = load_vectors(warped_gradient, at, here)
        gx += change * over_x
        gy += change * over_y
        gz += change * over_z
        x, y, z = load_vectors(points, at, here)
        if NEEDS_BEFORE:
            own = 1.0 - weight if TWO else 1.0
            scatter_vectors(before_into, own, slice_axes, x, y, z, gx, gy, gz, here)
        if NEEDS_AFTER:
            scatter_vectors(after_into, weight, slice_axes, x, y, z, gx, gy, gz, here)

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
    gradient_target,
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


class WarpedDepth(torch.autograd.Function):
    """As devrf.ops.warped_depth.warped_depth."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        axes: tuple[Tensor, Tensor],
        numbers: tuple[float, float, float],
        accumulated: Sequence[Tensor | None],
        density: Tensor,
        *slices: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Canonical positions (M, 3) and optical depths (M,).

        ``axes``: of the slices and of the density. ``numbers``: weight of the second slice, shift,
        delta. ``accumulated``: gradients of the density and each slice so far, or None.
        """
        points, grids = points.contiguous(), [grid.contiguous() for grid in (density, *slices)]
        # The kernel takes two slices; the density stands in for missing ones, which are not read.
        density, before, after = (*grids, *grids[:1] * 2)[:3]
        count = len(points)
        warped, tau = torch.empty_like(points), points.new_empty(count)
        launch(
            warped_depth_kernel,
            blocks(count),
            *(points, density, before, after, *axes, warped, tau, count, *numbers),
            SLICES=len(slices),
        )
        ctx.save_for_backward(points, warped, *grids)
        ctx.axes, ctx.numbers, ctx.accumulated = axes, numbers, accumulated
        ctx.set_materialize_grads(False)
        if not any(ctx.needs_input_grad[5:]):
            # Points get no gradient: without slices nothing that is looked up at q need find one.
            ctx.mark_non_differentiable(warped)
        return warped, tau

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_warped: Tensor | None, to_tau: Tensor | None) -> tuple[Any, ...]:
        points, warped, *grids = ctx.saved_tensors
        targets = [
            gradient_target(grid, need, accumulated)
            for grid, need, accumulated in zip(
                grids, ctx.needs_input_grad[4:], ctx.accumulated, strict=True
            )
        ]
        into, gradients, adds = zip(*targets, *[(grids[0], None, False)] * 2, strict=False)
        if to_tau is None:
            to_tau = points.new_zeros(len(points))
        if to_warped is None:
            # The kernel reads it for slices alone; any pointer serves where there are none.
            to_warped = torch.zeros_like(points) if any(adds[1:]) else points
        launch(
            warped_depth_backward_kernel,
            blocks(len(points)),
            *(points, grids[0], warped, to_warped.contiguous(), to_tau.contiguous(), *into[:3]),
            *(*ctx.axes, len(points), *ctx.numbers),
            NEEDS_DENSITY=adds[0],
            NEEDS_BEFORE=adds[1],
            NEEDS_AFTER=adds[2],
            TWO=len(grids) > 2,
        )
        return None, None, None, None, *gradients[: len(grids)]


warped_depth = WarpedDepth.apply


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
    mask = point < count
    at = point.to(tl.int64) * 3
    x, y, z = load_vectors(points, at, mask)
    if SLICES > 0:
        x, y, z = displaced(before, after, weight, slice_axes, x, y, z, mask, SLICES)
    store_vectors(warped, at, x, y, z, mask)
    raw = scalar_at(density, density_axes, x, y, z, mask)
    tl.store(tau + point, softplus(raw + shift) * delta, mask=mask)


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
    mask = point < count
    at = point.to(tl.int64) * 3
    x, y, z = load_vectors(warped, at, mask)
    raw, over_x, over_y, over_z = scalar_and_slopes(density, density_axes, x, y, z, mask)
    change = tl.load(tau_gradient + point, mask=mask, other=0.0) * sigmoid(raw + shift) * delta
    if NEEDS_DENSITY:
        scatter_scalars(density_into, density_axes, x, y, z, change, mask)
    if NEEDS_BEFORE or NEEDS_AFTER:
        gx, gy, gz = load_vectors(warped_gradient, at, mask)
        gx += change * over_x
        gy += change * over_y
        gz += change * over_z
        x, y, z = load_vectors(points, at, mask)
        if NEEDS_BEFORE:
            weight_before = 1.0 - weight if TWO else 1.0
            scatter_vectors(before_into, weight_before, slice_axes, x, y, z, gx, gy, gz, mask)
        if NEEDS_AFTER:
            scatter_vectors(after_into, weight, slice_axes, x, y, z, gx, gy, gz, mask)

"""Trilinear interpolation of a channels-last grid: rows of channels are loaded as vectors.

A program processes a block of points. Their channels form a tile whose width is the next power of
two, so that neighbouring threads read neighbouring numbers: four each if the number of channels is
a multiple of four, else one.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import (
    blocks,
    cell,
    corner_row,
    corner_slopes,
    corner_weight,
    gradient_target,
    launch,
    load_vectors,
    pace,
    store_vectors,
)

THREADS = 128


class Interpolate(torch.autograd.Function):
    """As devrf.ops.trilinear.interpolate; ``axes`` are those of the grid in its own units."""

    @staticmethod
    def forward(
        ctx: Any, grid: Tensor, coords: Tensor, axes: Tensor, accumulated: Tensor | None
    ) -> Tensor:
        grid, coords = grid.contiguous(), coords.contiguous()
        ctx.save_for_backward(grid, coords, axes)
        ctx.accumulated = accumulated
        count, tile = len(coords), _tile(grid.shape[3])
        out = grid.new_empty(count, grid.shape[3])
        launch(
            interpolate_kernel, blocks(count, tile["BLOCK"]), grid, axes, coords, out, count, **tile
        )
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        grid, coords, axes = ctx.saved_tensors
        needs_grid, needs_coords, *_ = ctx.needs_input_grad
        into, gradient, adds = gradient_target(grid, needs_grid, ctx.accumulated)
        moved = torch.empty_like(coords)
        count, tile = len(coords), _tile(grid.shape[3])
        launch(
            interpolate_backward_kernel,
            blocks(count, tile["BLOCK"]),
            *(grid, axes, coords, upstream.contiguous(), into, moved, count),
            NEEDS_GRID=adds,
            NEEDS_COORDS=needs_coords,
            **tile,
        )
        return gradient, moved if needs_coords else None, None, None


interpolate = Interpolate.apply


def _tile(channels: int) -> dict[str, int]:
    """Constants of a kernel: channels, width of a tile, and how many points it holds."""
    padded = triton.next_power_of_2(channels)
    numbers = THREADS * (4 if channels % 4 == 0 else 1)
    return {"CHANNELS": channels, "PADDED": padded, "BLOCK": max(1, numbers // padded)}


@triton.jit
def rows_between(
    grid, axes, px, py, pz, mask, CHANNELS: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr
):
    """Σ_corners weight · grid[corner], a tile (BLOCK, PADDED); 0 behind the channels."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    channel = tl.arange(0, PADDED)
    wanted = mask[:, None] & (channel < CHANNELS)[None, :]
    total = tl.zeros((BLOCK, PADDED), dtype=tl.float32)
    for corner in tl.static_range(8):
        row = corner_row(first, along_x, along_y, corner)
        weight = corner_weight(fx, fy, fz, corner)
        place = row[:, None] * CHANNELS + channel[None, :]
        total += weight[:, None] * tl.load(grid + place, mask=wanted, other=0.0)
    return total


@triton.jit
def spread_rows(
    grid,
    axes,
    into,
    change,
    px,
    py,
    pz,
    mask,
    NEEDS_GRID: tl.constexpr,
    NEEDS_POINTS: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    """Scatter weight · change (BLOCK, PADDED) to the corners; the gradients of the positions."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    channel = tl.arange(0, change.shape[1])
    wanted = mask[:, None] & (channel < CHANNELS)[None, :]
    # Padding has no gradient; atomic additions of its zeros to one place would be serialised.
    changed = wanted & (tl.max(tl.abs(change), axis=1) > 0.0)[:, None]
    gx = fx * 0.0
    gy = fx * 0.0
    gz = fx * 0.0
    for corner in tl.static_range(8):
        row = corner_row(first, along_x, along_y, corner)
        weight = corner_weight(fx, fy, fz, corner)
        place = row[:, None] * CHANNELS + channel[None, :]
        if NEEDS_GRID:
            tl.atomic_add(into + place, weight[:, None] * change, mask=changed, sem="relaxed")
        if NEEDS_POINTS:
            value = tl.load(grid + place, mask=wanted, other=0.0)
            agreed = tl.sum(value * change, axis=1)
            dx, dy, dz = corner_slopes(agreed, fx, fy, fz, corner)
            gx += dx
            gy += dy
            gz += dz
    return gx * pace(axes, 0, px), gy * pace(axes, 1, py), gz * pace(axes, 2, pz)


@triton.jit(do_not_specialize=["count"])
def interpolate_kernel(
    grid,
    axes,
    coords,
    out,
    count,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """out[m] = Σ_corners weight · grid[corner]."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = point < count
    x, y, z = load_vectors(coords, point.to(tl.int64) * 3, mask)
    total = rows_between(grid, axes, x, y, z, mask, CHANNELS, PADDED, BLOCK)
    channel = tl.arange(0, PADDED)
    wanted = mask[:, None] & (channel < CHANNELS)[None, :]
    into = point.to(tl.int64)[:, None] * CHANNELS + channel[None, :]
    tl.store(out + into, total, mask=wanted)


@triton.jit(do_not_specialize=["count"])
def interpolate_backward_kernel(
    grid,
    axes,
    coords,
    upstream,
    grid_gradient,
    coords_gradient,
    count,
    NEEDS_GRID: tl.constexpr,
    NEEDS_COORDS: tl.constexpr,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Scatter weight · upstream to the corners; slopes along the axes to the coordinates."""
    point = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = point < count
    at = point.to(tl.int64) * 3
    x, y, z = load_vectors(coords, at, mask)
    channel = tl.arange(0, PADDED)
    wanted = mask[:, None] & (channel < CHANNELS)[None, :]
    from_ = point.to(tl.int64)[:, None] * CHANNELS + channel[None, :]
    change = tl.load(upstream + from_, mask=wanted, other=0.0)
    gx, gy, gz = spread_rows(
        grid, axes, grid_gradient, change, x, y, z, mask, NEEDS_GRID, NEEDS_COORDS, CHANNELS
    )
    if NEEDS_COORDS:
        store_vectors(coords_gradient, at, gx, gy, gz, mask)

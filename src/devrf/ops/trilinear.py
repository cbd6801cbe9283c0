"""Trilinear interpolation of a channels-last grid, with gradients to values and positions.

The eight corners of a cell are consecutive rows of memory apart, so a look-up is a weighted sum
of eight rows: exactly what an embedding bag does, in one pass and without intermediate copies.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

Pair = tuple[Tensor, Tensor]


def interpolate(grid: Tensor, coords: Tensor) -> Tensor:
    """Values of a grid between its points.

    ``out[m] = Σ_{i,j,k ∈ {0,1}} Π_axis w_axis(i,j,k) · grid[⌊c⌋ + (i,j,k)]`` with linear weights;
    coordinates are clamped to the grid, so outside it values are those of the border and the
    gradient to the position is zero.

    Args:
        grid: (X, Y, Z, C), at least two points along each axis.
        coords: (M, 3) in grid units: 0 … X − 1, 0 … Y − 1, 0 … Z − 1.

    Returns:
        (M, C), differentiable once in ``grid`` and ``coords``.
    """
    values: Tensor = _Interpolate.apply(grid, coords)  # type: ignore[no-untyped-call]
    return values


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, coords: Tensor) -> Tensor:
        rows, fraction, inside = _cell(coords, grid.shape[:3])
        ctx.save_for_backward(grid, rows, fraction, inside)
        table = grid.reshape(-1, grid.shape[3])
        return _bag(rows, table, _corner_weights(_linear(fraction)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        grid, rows, fraction, inside = ctx.saved_tensors
        grid_grad = coords_grad = None
        table = grid.reshape(-1, grid.shape[3])
        weights = _linear(fraction)
        if ctx.needs_input_grad[0]:
            grid_grad = _scatter(rows, _corner_weights(weights), grad, len(table))
            grid_grad = grid_grad.reshape(grid.shape)
        if ctx.needs_input_grad[1]:
            coords_grad = torch.empty_like(fraction)
            rise = torch.ones_like(fraction[:, 0])
            for axis in range(3):
                sloped = [*weights[:axis], (-rise, rise), *weights[axis + 1 :]]
                change = _bag(rows, table, _corner_weights(sloped))
                coords_grad[:, axis] = (change * grad).sum(dim=1)
            coords_grad = coords_grad * inside
        return grid_grad, coords_grad


def _cell(coords: Tensor, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (M, 8) of each point's corners, fractions (M, 3) in the cell, inside mask (M, 3)."""
    last = coords.new_tensor(shape) - 1
    clamped = torch.minimum(coords.clamp(min=0), last)
    base = torch.minimum(clamped.floor(), last - 1)
    i, j, k = base.to(torch.int32).unbind(-1)
    first = (i * shape[1] + j) * shape[2] + k
    steps = [
        (a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)
    ]
    rows = first[:, None] + torch.tensor(steps, dtype=torch.int32, device=coords.device)
    return rows, clamped - base, (coords >= 0) & (coords <= last)


def _linear(fraction: Tensor) -> list[Pair]:
    """Per axis the weights (M,), (M,) of the lower and the upper corner."""
    return [(1 - f, f) for f in fraction.t().contiguous()]


def _corner_weights(axes: list[Pair]) -> Tensor:
    """Products (M, 8) of the three axes' weights, in the order of the corners' rows."""
    x, y, z = axes
    # Whole vectors are multiplied and transposed at the end: broadcasting over pairs is slow.
    weights = z[0].new_empty(8, len(z[0]))
    for k, row in enumerate(weights):
        torch.mul(x[k >> 2] * y[(k >> 1) & 1], z[k & 1], out=row)
    return weights.t().contiguous()


def _bag(rows: Tensor, table: Tensor, weights: Tensor) -> Tensor:
    if len(rows) == 0:
        return table.new_zeros(0, table.shape[1])
    return embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def _scatter(rows: Tensor, weights: Tensor, values: Tensor, count: int) -> Tensor:
    """The transpose of :func:`_bag`: Σ weights · values (M, C) into (count, C)."""
    channels = values.shape[1]
    if values.is_cuda:
        spread = weights[:, :, None] * values[:, None, :]
        into = values.new_zeros(count, channels)
        return into.index_add_(0, rows.reshape(-1), spread.reshape(-1, channels))
    # On a CPU adding rows is ten times slower than adding numbers, channel by channel.
    into = values.new_zeros(count * channels)
    first = rows.reshape(-1).long() * channels
    for channel, value in enumerate(values.t()):
        into.scatter_add_(0, first + channel, (weights * value[:, None]).reshape(-1))
    return into.view(count, channels)

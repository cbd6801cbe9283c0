"""Trilinear interpolation of a channels-last grid, with gradients to values and positions.

A look-up is a weighted sum of eight rows of a table, as an embedding bag computes it: in one pass
and without intermediate copies.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from devrf.ops.corners import Shape, shape_of

Pair = tuple[Tensor, Tensor]


def interpolate(grid: Tensor, coords: Tensor, *, gradient: Tensor | None = None) -> Tensor:
    """Values of a grid between its points.

    ``out[m] = Σ_{i,j,k ∈ {0,1}} Π_axis w_axis(i,j,k) · grid[⌊c⌋ + (i,j,k)]`` with linear weights;
    coordinates are clamped to the grid, so outside it values are those of the border and the
    gradient to the position is zero.

    Args:
        grid: (X, Y, Z, C), at least two points along each axis.
        coords: (M, 3) in grid units: 0 … X − 1, 0 … Y − 1, 0 … Z − 1.
        gradient: None, or a contiguous tensor (X, Y, Z, C) to which the backward pass adds the
            grid's gradient, instead of returning it to autograd: faster where few points of a
            large grid are touched.

    Returns:
        (M, C), differentiable once in ``grid`` and ``coords``.
    """
    values: Tensor = _Interpolate.apply(grid, coords, gradient)  # type: ignore[no-untyped-call]
    return values


def resample(values: Tensor, shape: Shape) -> Tensor:
    """A grid (X, Y, Z, C) at another resolution ``shape``, trilinear, corners kept in place."""
    if tuple(values.shape[:3]) == tuple(shape):
        return values.detach().clone()
    channels_first = values.permute(3, 0, 1, 2)[None]
    resized = torch.nn.functional.interpolate(
        channels_first, size=shape, mode="trilinear", align_corners=True
    )
    # Not contiguous(): of a single channel it keeps a stray stride, and look-ups become slow.
    return resized[0].permute(1, 2, 3, 0).clone(memory_format=torch.contiguous_format)


def kept_gradient(leaf: Tensor) -> Tensor | None:
    """The gradient that ``leaf`` already has, if any: ``gradient`` of :func:`interpolate`.

    Autograd would add to it, too, but with a temporary tensor of the grid's size.
    """
    return leaf.grad if leaf.requires_grad and leaf.is_leaf else None


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, coords: Tensor, gradient: Tensor | None) -> Tensor:
        first, fraction = _cell(coords, shape_of(grid))
        ctx.save_for_backward(grid, coords, first, fraction)
        ctx.gradient = gradient
        table = grid.reshape(-1, grid.shape[3])
        rows = _corner_rows(first, shape_of(grid))
        return _bag(rows, table, _corner_weights(_linear(fraction)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        grid, coords, first, fraction = ctx.saved_tensors
        grid_grad = coords_grad = None
        rows = _corner_rows(first, shape_of(grid))
        table = grid.reshape(-1, grid.shape[3])
        into = ctx.gradient
        if into is None and ctx.needs_input_grad[0]:
            into = grid_grad = torch.zeros_like(grid, memory_format=torch.contiguous_format)
        if into is not None:
            _scatter(rows, _corner_weights(_linear(fraction)), grad, into.view(table.shape))
        if ctx.needs_input_grad[1]:
            slopes = torch.stack(_slopes(_pulls(rows, table, grad), fraction))
            for axis, points in enumerate(shape_of(grid)):
                slopes[axis] *= (coords[:, axis] >= 0) & (coords[:, axis] <= points - 1)
            coords_grad = slopes.t()
        return grid_grad, coords_grad, None


def _cell(coords: Tensor, shape: Shape) -> tuple[Tensor, Tensor]:
    """Row (M,) of each point's lowest corner, and fractions (3, M) within the cell.

    Axis by axis: whole vectors are several times faster than rows of three.
    """
    along = coords.t().contiguous()
    fraction = torch.empty_like(along)
    first = torch.zeros_like(along[0], dtype=torch.int32)
    for axis, points in enumerate(shape):
        clamped = along[axis].clamp(0, points - 1)
        base = clamped.floor().clamp_(max=points - 2)
        torch.sub(clamped, base, out=fraction[axis])
        first.mul_(points).add_(base.to(torch.int32))
    return first, fraction


def _corner_rows(first: Tensor, shape: Shape) -> Tensor:
    """Rows (M, 8) of the corners of cells whose lowest corners are in rows ``first`` (M,)."""
    return first[:, None] + _steps(shape, first.device)


@cache
def _steps(shape: Shape, device: torch.device) -> Tensor:
    """Rows (8,) of a cell's corners from its first one.

    Cached on the device: to copy them there at every step, the host would wait for the device.
    """
    steps = [(a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    # A cached tensor made in inference mode could not be used for training later.
    with torch.inference_mode(False):
        return torch.tensor(steps, dtype=torch.int32).to(device)


def _linear(fraction: Tensor) -> list[Pair]:
    """Per axis the weights (M,), (M,) of the lower and the upper corner."""
    return [(1 - f, f) for f in fraction]


def _corner_weights(axes: list[Pair]) -> Tensor:
    """Products (M, 8) of the three axes' weights, in the order of the corners' rows."""
    x, y, z = axes
    weights = z[0].new_empty(len(z[0]), 8)
    for pair in range(4):
        side = x[pair >> 1] * y[pair & 1]
        # Column by column: broadcasting over pairs, or one transposition at the end, is slower.
        torch.mul(side, z[0], out=weights[:, 2 * pair])
        torch.mul(side, z[1], out=weights[:, 2 * pair + 1])
    return weights


def _pulls(rows: Tensor, table: Tensor, grad: Tensor) -> Tensor:
    """∂/∂(weight of each corner), (8, M): its row times the gradient (M, C)."""
    corners = table.index_select(0, rows.t().reshape(-1)).view(8, *grad.shape)
    if grad.shape[1] == 1:
        return corners[..., 0] * grad[:, 0]
    return corners.mul_(grad).sum(dim=2)


def _slopes(pulls: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes of Σ weights · pulls along x, y and z, (M,) each; interpolated axis by axis.

    Args:
        pulls: (8, M) in the order of the corners' rows.
        fraction: (3, M) within the cell.
    """
    (x, y, z), count = fraction, pulls.shape[1]
    low, high = pulls.view(4, 2, count).unbind(1)
    over_z, at_z = high - low, low.lerp(high, z)
    low, high = at_z.view(2, 2, count).unbind(1)
    over_y, at_y = high - low, low.lerp(high, y)
    low, high = over_z.view(2, 2, count).unbind(1)
    over_z = low.lerp(high, y)
    return at_y[1] - at_y[0], over_y[0].lerp(over_y[1], x), over_z[0].lerp(over_z[1], x)


def _bag(rows: Tensor, table: Tensor, weights: Tensor) -> Tensor:
    if len(rows) == 0:
        return table.new_zeros(0, table.shape[1])
    return embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def _scatter(rows: Tensor, weights: Tensor, values: Tensor, into: Tensor) -> None:
    """The transpose of :func:`_bag`: adds Σ weights · values (M, C) to rows of ``into``."""
    channels = values.shape[1]
    if values.is_cuda:
        spread = weights[:, :, None] * values[:, None, :]
        into.index_add_(0, rows.reshape(-1), spread.reshape(-1, channels))
        return
    # On a CPU adding rows is ten times slower than adding numbers, channel by channel.
    flat, first = into.view(-1), rows.reshape(-1).long() * channels
    for channel, value in enumerate(values.t()):
        flat.scatter_add_(0, first + channel, (weights * value[:, None]).reshape(-1))

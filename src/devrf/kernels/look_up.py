"""Look-ups: the values of a grid between its points (docs/method.md#notation)."""

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.geometry.box import Box
from devrf.kernels.grid import Grid, cell, grid_over, inside, interpolate, slope
from devrf.kernels.runtime import array, by_channels, launch, launch_by_owner, row_type, take
from devrf.ops import trilinear


def look_up(grid: Tensor, points: Tensor, box: Box) -> Tensor:
    """Trilinear values of a grid over a box; outside they are those of the border.

    Args:
        grid: (X, Y, Z, C), at least two points along x and y; one along z is a plane, the same for
            all z. A leaf that has a gradient is added to there, without a temporary tensor of the
            grid's size.
        points: (M, 3) in the box's units.
        box: where the grid's outer points lie.

    Returns:
        (M, C), differentiable once in ``grid`` and ``points``.
    """
    if not take(points):
        return trilinear.look_up(grid, points, box)
    kept = grid.grad if grid.is_leaf else None
    values: Tensor = _LookUp.apply(grid, points, box, kept)  # type: ignore[no-untyped-call]
    return values


class _LookUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, points: Tensor, box: Box, kept: Tensor | None) -> Tensor:
        grid = grid.contiguous()
        points = points.contiguous()
        ctx.save_for_backward(grid, points)
        ctx.box, ctx.kept = box, kept
        values = grid.new_empty(len(points), grid.shape[-1])
        inputs = [place(grid, box), array(points), array(grid), array(values)]
        launch(look_up_kernel(grid.shape[-1]), len(points), inputs, points.device)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        grid, points = ctx.saved_tensors
        gradient = gradient.contiguous()
        of_grid = of_points = None
        if ctx.needs_input_grad[0]:
            of_grid = torch.zeros_like(grid) if ctx.kept is None else None
            add_to_grid(ctx.kept if of_grid is None else of_grid, points, gradient, ctx.box)
        if ctx.needs_input_grad[1]:
            of_points = torch.empty_like(points)
            inputs = [place(grid, ctx.box), array(points), array(grid), array(gradient)]
            inputs.append(array(of_points))
            launch(slope_kernel(grid.shape[-1]), len(points), inputs, points.device)
        return of_grid, of_points, None, None


def add_to_grid(grid: Tensor, points: Tensor, values: Tensor, box: Box) -> None:
    """The adjoint of a look-up: add weight · ``values`` (M, C) to the corners around ``points``.

    Args:
        grid: (X, Y, Z, C), changed in place.
        points: (M, 3) in the box's units.
        values: (M, C).
        box: where the grid's outer points lie.
    """
    inputs = [place(grid, box), array(points), array(values), array(grid)]
    launch_by_owner(add_kernel(grid.shape[-1]), len(points), inputs, points.device)


def place(grid: Tensor, box: Box) -> Grid:
    """Where the points of a grid (X, Y, Z, C) over ``box`` are."""
    x, y, z = grid.shape[:3]
    return grid_over(box, (x, y, z))


@by_channels
def look_up_kernel(channels: int) -> wp.Kernel:
    """The look-up in grids of so many channels: Warp chooses slowly among kernels of one name."""
    row_of = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def look_up(
        first: int,
        grid: Grid,
        points: wp.array(dtype=wp.vec3),
        values: wp.array(dtype=row_of),
        result: wp.array(dtype=row_of),
    ):
        sample = first + wp.tid()
        row, fraction = cell(grid, points[sample])
        result[sample] = interpolate(values, grid, row, fraction)

    return look_up


@by_channels
def slope_kernel(channels: int) -> wp.Kernel:
    """The look-up's adjoint in the points."""
    row_of = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def slopes(
        first: int,
        grid: Grid,
        points: wp.array(dtype=wp.vec3),
        values: wp.array(dtype=row_of),
        gradient: wp.array(dtype=row_of),
        result: wp.array(dtype=wp.vec3),
    ):
        """From the gradient of looked-up values to that of the points."""
        sample = first + wp.tid()
        point = points[sample]
        row, fraction = cell(grid, point)
        change = slope(values, gradient[sample], grid, row, fraction)
        result[sample] = wp.cw_mul(change, inside(grid, point))

    return slopes


@by_channels
def add_kernel(channels: int) -> wp.Kernel:
    """The look-up's adjoint in the grid."""
    row_of = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_grid(
        owner: int,
        owners: int,
        grid: Grid,
        points: wp.array(dtype=wp.vec3),
        values: wp.array(dtype=row_of),
        result: wp.array(dtype=row_of),
    ):
        """Planes of the grid across x belong to the owners in turn."""
        sample = wp.tid()
        row, f = cell(grid, points[sample])
        next_y = grid.z
        next_x = grid.y * grid.z
        plane = row / next_x
        value = values[sample]
        if plane % owners == owner:
            low = value * (1.0 - f[0])
            wp.atomic_add(result, row, low * ((1.0 - f[1]) * (1.0 - f[2])))
            wp.atomic_add(result, row + next_y, low * (f[1] * (1.0 - f[2])))
            if grid.z > 1:
                wp.atomic_add(result, row + 1, low * ((1.0 - f[1]) * f[2]))
                wp.atomic_add(result, row + next_y + 1, low * (f[1] * f[2]))
        if (plane + 1) % owners == owner:
            high = value * f[0]
            row += next_x
            wp.atomic_add(result, row, high * ((1.0 - f[1]) * (1.0 - f[2])))
            wp.atomic_add(result, row + next_y, high * (f[1] * (1.0 - f[2])))
            if grid.z > 1:
                wp.atomic_add(result, row + 1, high * ((1.0 - f[1]) * f[2]))
                wp.atomic_add(result, row + next_y + 1, high * (f[1] * f[2]))

    return add_to_grid

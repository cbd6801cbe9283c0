"""Trilinear interpolation of a grid, and its adjoints (docs/method.md#notation)."""

import torch
import warp as wp
from torch import Tensor

from devrf.geometry.box import Box
from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.grid import Grid, add_cell, cell, grid_over, inside, interpolate_cell, slope
from devrf.kernels.runtime import cached_kernel, is_supported, launch, row_type
from devrf.ops import trilinear as definition
from devrf.ops.trilinear import shape_of


def interpolate(grid: Tensor, points: Tensor, box: Box, stride: int = 1) -> Tensor:
    """As :func:`devrf.ops.trilinear.interpolate`, differentiable once.

    A leaf that has a gradient is added to there, without a temporary tensor of the grid's size.
    """
    if not is_supported(points):
        return definition.interpolate(grid, points, box, stride)
    kept = grid.grad if grid.is_leaf else None
    table, places = grid.detach().contiguous(), points.detach().contiguous()
    geometry = grid_over(box, shape_of(grid), stride)
    values = grid.new_empty(len(points), grid.shape[-1])
    inputs = [geometry, places, table, values]
    launch(interpolate_kernel(grid.shape[-1]), len(points), inputs, points.device)

    def adjoint(gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        of_grid = of_points = None
        if grid.requires_grad:
            of_grid = torch.zeros_like(table) if kept is None else None
            into = kept if of_grid is None else of_grid
            add_to_grid(into, places, gradient, box, stride)
        if points.requires_grad:
            of_points = torch.empty_like(places)
            inputs = [geometry, places, table, gradient, of_points]
            launch(slope_kernel(grid.shape[-1]), len(points), inputs, points.device)
        return of_grid, of_points

    return with_adjoint((values,), (grid, points), adjoint)[0]


def add_to_grid(grid: Tensor, points: Tensor, values: Tensor, box: Box, stride: int = 1) -> None:
    """Add weight · ``values`` (M, C) to the corners around ``points``: interpolation's adjoint.

    A GPU adds atomically, a CPU in one thread, in the order of the points. Two threads, each with
    planes of its own, took twice as long: a thread that guesses wrongly whose plane it is fetches
    memory that the other writes.

    Args:
        grid: (X, Y, Z, C), changed in place.
        points: (M, 3) in the box's units.
        values: (M, C).
        box: the grid's outer points lie on it.
        stride: as of :func:`interpolate`.
    """
    inputs = [grid_over(box, shape_of(grid), stride), points, values, grid]
    launch(add_kernel(grid.shape[-1]), len(points), inputs, points.device, grain=None)


@cached_kernel
def interpolate_kernel(channels: int) -> wp.Kernel:
    """Interpolation of grids of so many channels: Warp is slow to choose among overloads."""
    row_of = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def interpolate(
        first: int,
        grid: Grid,
        points: wp.array(dtype=wp.vec3),
        values: wp.array(dtype=row_of),
        result: wp.array(dtype=row_of),
    ):
        sample = first + wp.tid()
        row, fraction = cell(grid, points[sample])
        result[sample] = interpolate_cell(values, grid, row, fraction)

    return interpolate


@cached_kernel
def slope_kernel(channels: int) -> wp.Kernel:
    """The adjoint of interpolation in the points."""
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
        """The gradient of the points from that of the interpolated values."""
        sample = first + wp.tid()
        point = points[sample]
        row, fraction = cell(grid, point)
        change = slope(values, gradient[sample], grid, row, fraction)
        result[sample] = wp.cw_mul(change, inside(grid, point))

    return slopes


@cached_kernel
def add_kernel(channels: int) -> wp.Kernel:
    """The adjoint of interpolation in the grid."""
    row_of = row_type(channels)

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_grid(
        first: int,
        grid: Grid,
        points: wp.array(dtype=wp.vec3),
        values: wp.array(dtype=row_of),
        result: wp.array(dtype=row_of),
    ):
        sample = first + wp.tid()
        row, fraction = cell(grid, points[sample])
        add_cell(result, grid, row, fraction, values[sample])

    return add_to_grid

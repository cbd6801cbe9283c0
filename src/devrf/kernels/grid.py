"""A grid as kernels know it, the cell that holds a point, and interpolation in the cell."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import warp as wp

from devrf.geometry.box import Box
from devrf.ops.trilinear import Shape


@wp.struct
class Grid:
    """A grid of x · y · z points, z first in memory, whose outer points lie on a box.

    A plane has one point along z, and is the same for all z.

    Attributes:
        low: the box's corner with the smallest coordinates.
        high: the one with the largest.
        scale: grid points to a unit of length, along each axis.
        next_x, next_y, next_z: rows of memory from a point to the next one along each axis.
    """

    low: wp.vec3
    high: wp.vec3
    scale: wp.vec3
    x: int
    y: int
    z: int
    next_x: int
    next_y: int
    next_z: int


@lru_cache(maxsize=256)
def grid_over(box: Box, shape: Shape, stride: int = 1) -> Grid:
    """The grid of ``shape`` (X, Y, Z) over ``box``, or every ``stride``-th of its points."""
    points = [(count - 1) // stride + 1 for count in shape]
    grid = Grid()
    grid.low, grid.high = wp.vec3(*box.low), wp.vec3(*box.high)
    grid.scale = wp.vec3(*((n - 1) / edge for n, edge in zip(points, box.size, strict=True)))
    grid.x, grid.y, grid.z = points
    grid.next_x = stride * shape[1] * shape[2]
    grid.next_y = stride * shape[2]
    grid.next_z = stride if points[2] > 1 else 0
    return grid


@wp.func
def coordinates(grid: Grid, point: wp.vec3):
    """0 on the low faces, x − 1, y − 1, z − 1 on the high ones."""
    return wp.cw_mul(point - grid.low, grid.scale)


@wp.func
def cell(grid: Grid, point: wp.vec3):
    """The row of the lowest corner of a point's cell, and the position in the cell, in [0, 1]³.

    A point outside the grid counts as the nearest point on its border.
    """
    at = coordinates(grid, point)
    x = wp.clamp(at[0], 0.0, float(grid.x - 1))
    y = wp.clamp(at[1], 0.0, float(grid.y - 1))
    z = wp.clamp(at[2], 0.0, float(grid.z - 1))
    i = wp.min(int(x), grid.x - 2)
    j = wp.min(int(y), grid.y - 2)
    k = wp.max(wp.min(int(z), grid.z - 2), 0)
    row = i * grid.next_x + j * grid.next_y + k * grid.next_z
    return row, wp.vec3(x - float(i), y - float(j), z - float(k))


@wp.func
def inside(grid: Grid, point: wp.vec3):
    """1 for each axis along which the point lies in the grid, else 0."""
    at = coordinates(grid, point)
    return wp.vec3(
        wp.where(at[0] >= 0.0 and at[0] <= float(grid.x - 1), 1.0, 0.0),
        wp.where(at[1] >= 0.0 and at[1] <= float(grid.y - 1), 1.0, 0.0),
        wp.where(at[2] >= 0.0 and at[2] <= float(grid.z - 1), 1.0, 0.0),
    )


@wp.func
def interpolate_cell(values: wp.array(dtype=Any), grid: Grid, row: int, f: wp.vec3):
    """Σ over a cell's corners of weight · value: trilinear, at the position ``f`` in the cell."""
    total = values[row] * ((1.0 - f[0]) * (1.0 - f[1]) * (1.0 - f[2]))
    total += values[row + grid.next_y] * ((1.0 - f[0]) * f[1] * (1.0 - f[2]))
    total += values[row + grid.next_x] * (f[0] * (1.0 - f[1]) * (1.0 - f[2]))
    total += values[row + grid.next_x + grid.next_y] * (f[0] * f[1] * (1.0 - f[2]))
    if grid.z > 1:
        row += grid.next_z
        total += values[row] * ((1.0 - f[0]) * (1.0 - f[1]) * f[2])
        total += values[row + grid.next_y] * ((1.0 - f[0]) * f[1] * f[2])
        total += values[row + grid.next_x] * (f[0] * (1.0 - f[1]) * f[2])
        total += values[row + grid.next_x + grid.next_y] * (f[0] * f[1] * f[2])
    return total


@wp.func
def add_cell(result: wp.array(dtype=Any), grid: Grid, row: int, f: wp.vec3, value: Any):
    """The adjoint of :func:`interpolate_cell`: weight · ``value`` is added to a cell's corners."""
    next_y = grid.next_y
    next_z = grid.next_z
    part = value * (1.0 - f[0])
    for _ in range(2):  # the corners with the lower x, then those with the higher
        wp.atomic_add(result, row, part * ((1.0 - f[1]) * (1.0 - f[2])))
        wp.atomic_add(result, row + next_y, part * (f[1] * (1.0 - f[2])))
        if grid.z > 1:
            wp.atomic_add(result, row + next_z, part * ((1.0 - f[1]) * f[2]))
            wp.atomic_add(result, row + next_y + next_z, part * (f[1] * f[2]))
        row += grid.next_x
        part = value * f[0]


@wp.func
def slope(values: wp.array(dtype=Any), factor: Any, grid: Grid, row: int, f: wp.vec3):
    """∂/∂ position of the scalar product of :func:`interpolate_cell`'s value and ``factor``.

    Per unit of length, at the position ``f`` in the cell.
    """
    next_x = grid.next_x
    next_y = grid.next_y
    next_z = grid.next_z
    v000 = wp.dot(values[row], factor)
    v001 = wp.dot(values[row + next_z], factor)
    v010 = wp.dot(values[row + next_y], factor)
    v011 = wp.dot(values[row + next_y + next_z], factor)
    v100 = wp.dot(values[row + next_x], factor)
    v101 = wp.dot(values[row + next_x + next_z], factor)
    v110 = wp.dot(values[row + next_x + next_y], factor)
    v111 = wp.dot(values[row + next_x + next_y + next_z], factor)
    x_low = wp.lerp(v100 - v000, v101 - v001, f[2])
    x_high = wp.lerp(v110 - v010, v111 - v011, f[2])
    y_low = wp.lerp(v010 - v000, v011 - v001, f[2])
    y_high = wp.lerp(v110 - v100, v111 - v101, f[2])
    z_low = wp.lerp(v001 - v000, v011 - v010, f[1])
    z_high = wp.lerp(v101 - v100, v111 - v110, f[1])
    change = wp.vec3(
        wp.lerp(x_low, x_high, f[1]), wp.lerp(y_low, y_high, f[0]), wp.lerp(z_low, z_high, f[0])
    )
    return wp.cw_mul(change, grid.scale)

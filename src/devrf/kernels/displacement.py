"""The warp x → q = x + Δ(x) by a grid of displacements, as kernels know it."""

from __future__ import annotations

from functools import lru_cache

import warp as wp

from devrf.geometry.box import Box
from devrf.kernels.grid import Grid, cell, grid_over, inside, interpolate_cell, slope
from devrf.ops.trilinear import Shape


@wp.struct
class Warp:
    """A warp by displacements.

    Attributes:
        grid: of the displacements.
        moves: 1 where there are displacements, else 0: q = x.
        zero_outside_box: 1 where nothing moves outside the grid, else 0.
    """

    grid: Grid
    moves: int
    zero_outside_box: int


@lru_cache(maxsize=64)
def warp_of(box: Box | None, shape: Shape | None, zero_outside_box: bool) -> Warp:
    """The warp by displacements of ``shape`` (X, Y, Z) over ``box``; without them, none."""
    warp = Warp()
    if box is not None and shape is not None:
        warp.grid = grid_over(box, shape)
        warp.moves = 1
        warp.zero_outside_box = int(zero_outside_box)
    return warp


@wp.func
def follows(warp: Warp, point: wp.vec3):
    """Whether a point moves with the displacements around it."""
    if warp.moves == 0:
        return False
    return warp.zero_outside_box == 0 or wp.min(inside(warp.grid, point)) > 0.0


@wp.func
def warped(warp: Warp, displacements: wp.array(dtype=wp.vec3), point: wp.vec3):
    """q = x + Δ(x)."""
    if not follows(warp, point):
        return point
    row, fraction = cell(warp.grid, point)
    return point + interpolate_cell(displacements, warp.grid, row, fraction)


@wp.func
def slope_of_warped(
    warp: Warp, displacements: wp.array(dtype=wp.vec3), point: wp.vec3, given: wp.vec3
):
    """The gradient of a point x from that of its warped place, ``given``."""
    if not follows(warp, point):
        return given
    row, fraction = cell(warp.grid, point)
    change = slope(displacements, given, warp.grid, row, fraction)
    return given + wp.cw_mul(change, inside(warp.grid, point))

"""The cell of a grid that a point lies in, the cell's eight corners, and their weights.

Corner number c lies at ``(c >> 2, (c >> 1) & 1, c & 1)`` in the cell: bit 4 for x, 2 for y, 1
for z.
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def cell(coordinate, points):
    """Lower corner (int32) and fraction in the cell, along an axis of ``points`` grid points.

    A coordinate outside is clamped to the grid; NaN counts as 0.
    """
    last = points - 1.0
    clamped = tl.where(coordinate > 0.0, tl.minimum(coordinate, last), 0.0)
    base = tl.minimum(tl.floor(clamped), last - 1.0)
    return base.to(tl.int32), clamped - base


@triton.jit
def inside(coordinate, points):
    """1.0 where the coordinate lies on the grid, 0.0 where it was clamped."""
    return ((coordinate >= 0.0) & (coordinate <= points - 1.0)).to(tl.float32)


@triton.jit
def corner_row(i, j, k, y, z, CORNER: tl.constexpr):
    """Row of a cell's corner in a grid (X, y, z, C) seen as a table of rows; int64."""
    row = ((i + (CORNER >> 2)) * y + j + ((CORNER >> 1) & 1)) * z + k + (CORNER & 1)
    return row.to(tl.int64)


@triton.jit
def share(fraction, UPPER: tl.constexpr):
    """Linear weight of the lower or the upper end along one axis."""
    return fraction if UPPER else 1.0 - fraction


@triton.jit
def corner_weight(fx, fy, fz, CORNER: tl.constexpr):
    """Trilinear weight of a cell's corner."""
    return share(fx, CORNER & 4) * share(fy, CORNER & 2) * share(fz, CORNER & 1)


@triton.jit
def corner_slopes(value, fx, fy, fz, CORNER: tl.constexpr):
    """What the value at a cell's corner adds to the slopes per grid unit along x, y, z."""
    wx = share(fx, CORNER & 4)
    wy = share(fy, CORNER & 2)
    wz = share(fz, CORNER & 1)
    along_x = wy * wz * (value if CORNER & 4 else -value)
    along_y = wx * wz * (value if CORNER & 2 else -value)
    along_z = wx * wy * (value if CORNER & 1 else -value)
    return along_x, along_y, along_z


@triton.jit
def load_vectors(vectors, at, here):
    """The components x, y, z of vectors that begin at places ``at``; 0 where not ``here``."""
    x = tl.load(vectors + at, mask=here, other=0.0)
    y = tl.load(vectors + at + 1, mask=here, other=0.0)
    z = tl.load(vectors + at + 2, mask=here, other=0.0)
    return x, y, z


@triton.jit
def store_vectors(vectors, at, x, y, z, here):
    """The reverse of :func:`load_vectors`."""
    tl.store(vectors + at, x, mask=here)
    tl.store(vectors + at + 1, y, mask=here)
    tl.store(vectors + at + 2, z, mask=here)


@triton.jit
def scalar_at(grid, i, j, k, fx, fy, fz, y, z, here):
    """Trilinear value of a grid (X, y, z, 1) in the cell (i, j, k)."""
    value = fx * 0.0
    for corner in tl.static_range(8):
        row = corner_row(i, j, k, y, z, corner)
        weight = corner_weight(fx, fy, fz, corner)
        value += weight * tl.load(grid + row, mask=here, other=0.0)
    return value


@triton.jit
def scalar_slope(grid, i, j, k, fx, fy, fz, y, z, here):
    """Value of a grid (X, y, z, 1) in the cell, and its slopes per grid unit along x, y, z."""
    value = fx * 0.0
    along_x = fx * 0.0
    along_y = fx * 0.0
    along_z = fx * 0.0
    for corner in tl.static_range(8):
        row = corner_row(i, j, k, y, z, corner)
        at = tl.load(grid + row, mask=here, other=0.0)
        value += corner_weight(fx, fy, fz, corner) * at
        slope_x, slope_y, slope_z = corner_slopes(at, fx, fy, fz, corner)
        along_x += slope_x
        along_y += slope_y
        along_z += slope_z
    return value, along_x, along_y, along_z

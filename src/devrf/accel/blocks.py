"""What kernels are made of: cells of grids, accurate functions of one number, padding of lists."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

# Samples, points or rays of a program that has a thread for each.
BLOCK: tl.constexpr = tl.constexpr(128)
# Samples that a program of one warp goes over at a time, one for each thread.
LANES: tl.constexpr = tl.constexpr(32)
# Places of a list's padding that a program fills.
PADDING: tl.constexpr = tl.constexpr(128)


def launch(kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
    """Launch a kernel on the device of its first argument, which need not be the current one.

    Args:
        kernel: a Triton kernel.
        programs: size of the grid; 0 launches nothing.
        args: the kernel's arguments, a tensor first.
        constants: its constants, and Triton's options.
    """
    if programs:
        with torch.cuda.device_of(args[0]):
            run(kernel, programs, *args, **constants)


def run(kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
    """Launch on the current device; the one place where tests and benchmarks watch launches."""
    # Explicit, because its default differs between releases of Triton.
    kernel[(programs,)](*args, **constants, enable_fp_fusion=True)


def blocks(count: int, size: int = BLOCK.value) -> int:
    """How many programs go over ``count`` items, ``size`` each."""
    return -(-count // size)


def padding_programs(places: int) -> int:
    """How many programs fill the padding of a list of ``places``; they come behind the rays'."""
    return blocks(places, PADDING.value)


def gradient_target(
    leaf: Tensor, needed: bool, accumulated: Tensor | None
) -> tuple[Tensor, Tensor | None, bool]:
    """Where a kernel adds a leaf's gradient, what autograd is given of it, and whether it is added.

    Args:
        leaf: what the gradient belongs to; any pointer serves where none is added.
        needed: whether autograd asks for it.
        accumulated: the gradient that the leaf has already, which is added to in place; or None.
    """
    if accumulated is not None:
        return accumulated, None, True
    if not needed:
        return leaf, None, False
    gradient = torch.zeros_like(leaf)
    return gradient, gradient, True


@triton.jit
def padding_places(number, used, places):
    """The places of program ``number`` of those, and which of them are behind the ``used`` ones."""
    place = number.to(tl.int64) * PADDING + tl.arange(0, PADDING)
    return place, (place >= used) & (place < places)


@triton.jit
def load_vectors(vectors, at, mask):
    """The components x, y, z of vectors that begin at places ``at``; 0 where not ``mask``."""
    x = tl.load(vectors + at, mask=mask, other=0.0)
    y = tl.load(vectors + at + 1, mask=mask, other=0.0)
    z = tl.load(vectors + at + 2, mask=mask, other=0.0)
    return x, y, z


@triton.jit
def store_vectors(vectors, at, x, y, z, mask):
    """The reverse of :func:`load_vectors`."""
    tl.store(vectors + at, x, mask=mask)
    tl.store(vectors + at + 1, y, mask=mask)
    tl.store(vectors + at + 2, z, mask=mask)


@triton.jit
def grid_coordinate(axes, AXIS: tl.constexpr, position):
    """Grid coordinate of a position along an axis: 0 on the box's low face."""
    return (position - tl.load(axes + AXIS)) * tl.load(axes + 3 + AXIS)


@triton.jit
def lower_corner(axes, AXIS: tl.constexpr, position):
    """Lower corner (int32) of a position's cell along an axis, and the fraction in the cell.

    A position outside is clamped to the grid; NaN counts as its low face.
    """
    last = tl.load(axes + 6 + AXIS) - 1.0
    coordinate = grid_coordinate(axes, AXIS, position)
    clamped = tl.where(coordinate > 0.0, tl.minimum(coordinate, last), 0.0)
    base = tl.minimum(tl.floor(clamped), last - 1.0)
    return base.to(tl.int32), clamped - base


@triton.jit
def pace(axes, AXIS: tl.constexpr, position):
    """Grid points per unit of length along an axis; 0 where a position is clamped to the grid."""
    coordinate = grid_coordinate(axes, AXIS, position)
    on_grid = (coordinate >= 0.0) & (coordinate <= tl.load(axes + 6 + AXIS) - 1.0)
    return tl.where(on_grid, tl.load(axes + 3 + AXIS), 0.0)


@triton.jit
def cell(axes, px, py, pz):
    """The cell that a position lies in.

    Returns the row (int32) of its lowest corner in the grid seen as a table of rows, the rows from
    a corner to its neighbours along x and y, and the fractions in the cell.
    """
    i, fx = lower_corner(axes, 0, px)
    j, fy = lower_corner(axes, 1, py)
    k, fz = lower_corner(axes, 2, pz)
    along_y = tl.load(axes + 8).to(tl.int32)
    along_x = tl.load(axes + 7).to(tl.int32) * along_y
    return i * along_x + j * along_y + k, along_x, along_y, fx, fy, fz


@triton.jit
def corner_row(first, along_x, along_y, CORNER: tl.constexpr):
    """Row (int64) of corner number c, which is ``(c >> 2, (c >> 1) & 1, c & 1)`` in the cell."""
    row = first + (CORNER >> 2) * along_x + ((CORNER >> 1) & 1) * along_y + (CORNER & 1)
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
    over_x = wy * wz * (value if CORNER & 4 else -value)
    over_y = wx * wz * (value if CORNER & 2 else -value)
    over_z = wx * wy * (value if CORNER & 1 else -value)
    return over_x, over_y, over_z


@triton.jit
def scalar_at(grid, axes, px, py, pz, mask):
    """Trilinear value of a grid (X, Y, Z, 1)."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    value = fx * 0.0
    for corner in tl.static_range(8):
        row = corner_row(first, along_x, along_y, corner)
        weight = corner_weight(fx, fy, fz, corner)
        value += weight * tl.load(grid + row, mask=mask, other=0.0)
    return value


@triton.jit
def scalar_and_slopes(grid, axes, px, py, pz, mask):
    """Trilinear value of a grid (X, Y, Z, 1), and its slopes per unit of length along x, y, z."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    value = fx * 0.0
    over_x = fx * 0.0
    over_y = fx * 0.0
    over_z = fx * 0.0
    for corner in tl.static_range(8):
        at = tl.load(grid + corner_row(first, along_x, along_y, corner), mask=mask, other=0.0)
        value += corner_weight(fx, fy, fz, corner) * at
        dx, dy, dz = corner_slopes(at, fx, fy, fz, corner)
        over_x += dx
        over_y += dy
        over_z += dz
    return value, over_x * pace(axes, 0, px), over_y * pace(axes, 1, py), over_z * pace(axes, 2, pz)


@triton.jit
def scatter_scalars(into, axes, px, py, pz, change, mask):
    """Add gradients at positions to the eight corners' rows of a grid (X, Y, Z, 1)."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    # Padding has no gradient; atomic additions of its zeros to one place would be serialised.
    mask = mask & (change != 0.0)
    for corner in tl.static_range(8):
        row = corner_row(first, along_x, along_y, corner)
        part = corner_weight(fx, fy, fz, corner) * change
        tl.atomic_add(into + row, part, mask=mask, sem="relaxed")


@triton.jit
def displaced(before, after, weight, axes, px, py, pz, mask, SLICES: tl.constexpr):
    """Positions moved by one grid (X, Y, Z, 3) of displacements, or by two that are blended."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    for corner in tl.static_range(8):
        place = corner_row(first, along_x, along_y, corner) * 3
        part = corner_weight(fx, fy, fz, corner)
        dx, dy, dz = load_vectors(before, place, mask)
        if SLICES == 2:
            ex, ey, ez = load_vectors(after, place, mask)
            dx += weight * (ex - dx)
            dy += weight * (ey - dy)
            dz += weight * (ez - dz)
        px += part * dx
        py += part * dy
        pz += part * dz
    return px, py, pz


@triton.jit
def scatter_vectors(into, weight, axes, px, py, pz, gx, gy, gz, mask):
    """Add ``weight`` times gradients at positions to the corners' rows of a grid (X, Y, Z, 3)."""
    first, along_x, along_y, fx, fy, fz = cell(axes, px, py, pz)
    gx = gx * weight
    gy = gy * weight
    gz = gz * weight
    mask = mask & ((gx != 0.0) | (gy != 0.0) | (gz != 0.0))
    for corner in tl.static_range(8):
        place = corner_row(first, along_x, along_y, corner) * 3
        part = corner_weight(fx, fy, fz, corner)
        tl.atomic_add(into + place, part * gx, mask=mask, sem="relaxed")
        tl.atomic_add(into + place + 1, part * gy, mask=mask, sem="relaxed")
        tl.atomic_add(into + place + 2, part * gz, mask=mask, sem="relaxed")


# The hardware's exponential has a relative error of about 1e-7, its logarithm an absolute one of
# 1e-7; so the functions below use no logarithm. They stay accurate where plain formulas cancel.


@triton.jit
def softplus(x):
    """log(1 + exp(x)) = max(x, 0) + log(1 + e), e = exp(−|x|) ≤ 1.

    With s = e / (2 + e) ≤ 1/3, log(1 + e) = 2·artanh(s) = 2·(s + s³/3 + s⁵/5 + …).
    """
    e = tl.exp(-tl.abs(x))
    s = e / (2.0 + e)
    q = s * s
    series = 1.0 / 13.0 + q * (1.0 / 15.0)
    series = 1.0 / 11.0 + q * series
    series = 1.0 / 9.0 + q * series
    series = 1.0 / 7.0 + q * series
    series = 1.0 / 5.0 + q * series
    series = 1.0 / 3.0 + q * series
    return tl.maximum(x, 0.0) + 2.0 * s * (1.0 + q * series)


@triton.jit
def sigmoid(x):
    """1 / (1 + exp(−x)), the slope of softplus."""
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0.0, 1.0, e) / (1.0 + e)


@triton.jit
def opacity(tau):
    """1 − exp(−τ) for τ ≥ 0; for small τ by its series, whose next term is below 1e-7 of it."""
    series = 1.0 - tau * (1.0 / 6.0)
    series = 1.0 - tau * (1.0 / 5.0) * series
    series = 1.0 - tau * 0.25 * series
    series = 1.0 - tau * (1.0 / 3.0) * series
    series = 1.0 - tau * 0.5 * series
    return tl.where(tau < 0.25, tau * series, 1.0 - tl.exp(-tau))

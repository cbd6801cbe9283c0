"""The layers of the colour network on blocks of samples, and what rays give to the first.

Products are those of tensor cores, summed in single precision. A program's registers would not hold
the second layer: it is taken in shares of its units.
"""

from __future__ import annotations

import triton
import triton.language as tl

# Samples of a block, of which 64 would spill, and units of the second layer computed at a time.
BLOCK: tl.constexpr = tl.constexpr(32)
SHARE: tl.constexpr = tl.constexpr(16)
# The least side of a matrix that tensor cores multiply.
LEAST = 16


def padded(length: int) -> int:
    """The side of a tile that holds ``length`` numbers."""
    return max(LEAST, int(triton.next_power_of_2(length)))


@triton.jit
def product(left, right, PRECISION: tl.constexpr):
    """A matrix product of numbers in ``PRECISION``, summed in single precision."""
    return tl.dot(left.to(PRECISION), right.to(PRECISION), input_precision="ieee")


@triton.jit
def load_tile(matrix, row, column, rows, COLUMNS: tl.constexpr):
    """Rows and columns of a matrix (rows, COLUMNS); 0 beyond it."""
    mask = (row < rows)[:, None] & (column < COLUMNS)[None, :]
    return tl.load(matrix + row[:, None] * COLUMNS + column[None, :], mask=mask, other=0.0)


@triton.jit
def store_tile(matrix, row, column, rows, values, COLUMNS: tl.constexpr):
    """The reverse of :func:`load_tile`."""
    mask = (row < rows)[:, None] & (column < COLUMNS)[None, :]
    tl.store(matrix + row[:, None] * COLUMNS + column[None, :], values, mask=mask)


@triton.jit(do_not_specialize=["rays"])
def directions_kernel(
    viewdirs,
    octaves,
    v1,
    encoded,
    from_ray,
    rays,
    DIRECTIONS: tl.constexpr,
    ENCODED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
):
    """Encodes directions, (d, sin(2^k d), cos(2^k d)), and what the first layer gives of them."""
    # Three for each octave; at least one, which is then not used.
    angles: tl.constexpr = (DIRECTIONS - 3) // 2 if DIRECTIONS > 3 else 1
    ray = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column, unit = tl.arange(0, ENCODED), tl.arange(0, UNITS)
    angle = tl.maximum(column - 3, 0) % angles
    axis = tl.where(column < 3, column, angle % 3)
    wanted = (ray < rays)[:, None] & (column < DIRECTIONS)[None, :]
    along = tl.load(viewdirs + ray[:, None] * 3 + axis[None, :], mask=wanted, other=0.0)
    times = tl.load(octaves + angle // 3, mask=(column >= 3) & (column < DIRECTIONS), other=1.0)
    turned = along * times[None, :]
    waves = tl.where((column < 3 + angles)[None, :], tl.sin(turned), tl.cos(turned))
    values = tl.where(wanted, tl.where((column < 3)[None, :], along, waves), 0.0)
    store_tile(encoded, ray, column, rays, values, DIRECTIONS)
    weight = load_tile(v1, unit, column, WIDTH, DIRECTIONS)
    first_layer = product(values, tl.trans(weight), encoded.dtype.element_ty)
    store_tile(from_ray, ray, unit, rays, first_layer, WIDTH)


@triton.jit
def lower_units(
    features,
    from_ray,
    ray,
    w1,
    b1,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
):
    """What the first layer gives of samples on rays ``ray``, (BLOCK, UNITS)."""
    unit = tl.arange(0, UNITS)
    known = unit < WIDTH
    row = from_ray + ray[:, None] * WIDTH + unit[None, :]
    directions = tl.load(row, mask=known[None, :], other=0.0)
    weight = load_tile(w1, unit, tl.arange(0, features.shape[1]), WIDTH, CHANNELS)
    x = directions + product(features, tl.trans(weight), directions.dtype)
    x += tl.load(b1 + unit, mask=known, other=0.0)[None, :]
    return tl.maximum(x, 0.0).to(directions.dtype)


@triton.jit
def upper_units(lower, w2, b2, unit, WIDTH: tl.constexpr):
    """What units of the second layer give, (BLOCK, SHARE), and their weights."""
    weight = load_tile(w2, unit, tl.arange(0, lower.shape[1]), WIDTH, WIDTH).to(lower.dtype)
    x = product(lower, tl.trans(weight), lower.dtype)
    x += tl.load(b2 + unit, mask=unit < WIDTH, other=0.0)[None, :]
    return tl.maximum(x, 0.0).to(lower.dtype), weight


@triton.jit
def output_weights(w3, unit, WIDTH: tl.constexpr):
    """The weights of units of the second layer for red, green and blue, (1, SHARE) each."""
    known = unit < WIDTH
    red = tl.load(w3 + unit, mask=known, other=0.0)
    green = tl.load(w3 + WIDTH + unit, mask=known, other=0.0)
    blue = tl.load(w3 + 2 * WIDTH + unit, mask=known, other=0.0)
    return red[None, :], green[None, :], blue[None, :]

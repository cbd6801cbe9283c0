"""The colour network on listed samples: features, layers and sigmoid of a block in one program.

With features f and encoded directions e, RGB = sigmoid(w₃·h₂ + b₃), h₂ = relu(w₂·h₁ + b₂) and
h₁ = relu(w₁·f + v₁·e + b₁): so weights are named.

Products are those of tensor cores, summed in single precision. The backward pass computes the
layers again, in one launch for what samples lead to and in another for the weights. A program's
registers would not hold the second layer: it is taken in shares of its units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import launch, load_vectors, sigmoid, store_vectors
from devrf.accel.trilinear import rows_between, spread_rows

# Samples of a block, and units of the second layer that are computed at a time.
BLOCK, SHARE = 64, 32
PRECISIONS = {torch.float32: tl.float32, torch.bfloat16: tl.bfloat16, torch.float16: tl.float16}
# The least side of a matrix that tensor cores multiply.
LEAST = 16


def listed_colors(
    grid: Tensor,
    points: Tensor,
    axes: Tensor,
    known: tuple[Tensor, Tensor, Tensor],
    network: Sequence[Tensor],
    precision: torch.dtype,
    buffers: Sequence[Tensor | None],
) -> Tensor:
    """As devrf.ops.color_network.listed_colors.

    Args:
        grid: (X, Y, Z, C) features.
        points: (S, 3).
        axes: of the grid.
        known: viewdirs, ray and first.
        network: the fields of ``ColorNetwork``.
        precision: what the hidden layers are computed in.
        buffers: the gradients that grid and weights have already; None for those without one.
    """
    *weights, octaves = network
    units, encoded = weights[2].shape
    sizes = {
        "CHANNELS": grid.shape[3],
        "PADDED": _padded(grid.shape[3]),
        "DIRECTIONS": encoded,
        "ENCODED": _padded(encoded),
        "WIDTH": units,
        "UNITS": _padded(units),
        "SHARE": min(SHARE, _padded(units)),
        "PRECISION": PRECISIONS[precision],
        "BLOCK": BLOCK,
    }
    given = tuple(tensor.contiguous() for tensor in (*known, octaves))
    colors: Tensor = ListedColors.apply(
        points.contiguous(), given, axes, sizes, buffers, grid.contiguous(), *weights
    )
    return colors


def _padded(length: int) -> int:
    return max(LEAST, int(triton.next_power_of_2(length)))


class ListedColors(torch.autograd.Function):
    """As devrf.ops.color_network.listed_colors."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        known: Sequence[Tensor],
        axes: Tensor,
        sizes: dict[str, Any],
        buffers: Sequence[Tensor | None],
        grid: Tensor,
        *learned: Tensor,
    ) -> Tensor:
        weights = [weight.contiguous() for weight in learned]
        viewdirs, ray, first, octaves = known
        given = (viewdirs, ray, first, octaves, *weights)
        places, rays = len(points), len(first) - 1
        features, colors = grid.new_empty(places, grid.shape[3]), torch.empty_like(points)
        launch(
            color_network_kernel,
            triton.cdiv(places, BLOCK),
            points,
            *(*given, points, grid, axes, features, colors, places, rays),
            **sizes,
            num_warps=8,
        )
        ctx.save_for_backward(*given, points, grid, features, colors)
        ctx.axes, ctx.sizes, ctx.buffers = axes, sizes, buffers
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Any, ...]:
        *given, points, grid, features, colors = ctx.saved_tensors
        learned, asked = (grid, *given[4:]), ctx.needs_input_grad
        known = (*given, features, colors, upstream.contiguous())
        into, gradients, needs = [], [], []
        for tensor, need, buffer in zip(learned, asked[5:], ctx.buffers, strict=True):
            own = torch.zeros_like(tensor) if need and buffer is None else None
            gradients.append(own)
            needs.append(need or buffer is not None)
            # Any pointer where no gradient is needed.
            into.append(buffer if buffer is not None else tensor if own is None else own)
        rays, blocks = len(given[2]) - 1, int(triton.cdiv(len(points), BLOCK))
        moved = torch.empty_like(points) if asked[0] else None
        if needs[0] or moved is not None:
            launch(
                color_samples_backward_kernel,
                blocks,
                points,
                *(*known, points, grid, ctx.axes, points if moved is None else moved, into[0]),
                *(len(points), rays),
                NEEDS_POINTS=moved is not None,
                NEEDS_GRID=needs[0],
                **ctx.sizes,
                num_warps=8,
            )
        if any(needs[1:]):
            programs = min(blocks, _processors(points.device))
            launch(
                color_weights_backward_kernel,
                programs * (ctx.sizes["UNITS"] // ctx.sizes["SHARE"]),
                points,
                *(*known, *into[1:], rays, programs),
                NEEDS_DIRECTIONS=needs[3],
                **ctx.sizes,
                num_warps=8,
            )
        return moved, None, None, None, None, *gradients


def _processors(device: torch.device) -> int:
    """How many programs work at the same time; on a CPU more than one, so that tests add sums."""
    if device.type != "cuda":
        return 2
    return int(torch.cuda.get_device_properties(device).multi_processor_count)


@triton.jit
def load_features(features, place, channel, here, CHANNELS: tl.constexpr):
    """The kept features of samples, a tile (BLOCK, PADDED); 0 behind the channels."""
    wanted = here[:, None] & (channel < CHANNELS)[None, :]
    row = features + place[:, None] * CHANNELS + channel[None, :]
    return tl.load(row, mask=wanted, other=0.0)


@triton.jit
def product(left, right, PRECISION: tl.constexpr):
    """A matrix product of numbers in ``PRECISION``, summed in single precision."""
    return tl.dot(left.to(PRECISION), right.to(PRECISION), input_precision="ieee")


@triton.jit
def matrix(weight, row, column, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """A padded tile of weights (ROWS, COLUMNS)."""
    there = (row < ROWS)[:, None] & (column < COLUMNS)[None, :]
    return tl.load(weight + row[:, None] * COLUMNS + column[None, :], mask=there, other=0.0)


@triton.jit
def add_matrix(into, change, row, column, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Add a padded tile to a gradient (ROWS, COLUMNS)."""
    there = (row < ROWS)[:, None] & (column < COLUMNS)[None, :]
    tl.atomic_add(into + row[:, None] * COLUMNS + column[None, :], change, mask=there)


@triton.jit
def encoded_directions(
    viewdirs, octaves, ray, place, here, DIRECTIONS: tl.constexpr, ENCODED: tl.constexpr
):
    """d, sin(2^k d), cos(2^k d) of each sample's ray: a tile (BLOCK, ENCODED)."""
    # Three for each octave; at least one, which is then not used.
    angles: tl.constexpr = (DIRECTIONS - 3) // 2 if DIRECTIONS > 3 else 1
    own = tl.load(ray + place, mask=here, other=0)
    column = tl.arange(0, ENCODED)
    angle = tl.maximum(column - 3, 0) % angles
    axis = tl.where(column < 3, column, angle % 3)
    wanted = here[:, None] & (column < DIRECTIONS)[None, :]
    along = tl.load(viewdirs + own[:, None] * 3 + axis[None, :], mask=wanted, other=0.0)
    times = tl.load(octaves + angle // 3, mask=(column >= 3) & (column < DIRECTIONS), other=1.0)
    turned = along * times[None, :]
    waves = tl.where((column < 3 + angles)[None, :], tl.sin(turned), tl.cos(turned))
    return tl.where(wanted, tl.where((column < 3)[None, :], along, waves), 0.0)


@triton.jit
def lower_units(
    features,
    encoded,
    w1,
    b1,
    v1,
    CHANNELS: tl.constexpr,
    DIRECTIONS: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """What the first layer gives, (BLOCK, UNITS) in ``PRECISION``."""
    unit = tl.arange(0, UNITS)
    channel, column = tl.arange(0, features.shape[1]), tl.arange(0, encoded.shape[1])
    weight = matrix(w1, unit, channel, WIDTH, CHANNELS)
    x = product(features, tl.trans(weight), PRECISION)
    weight = matrix(v1, unit, column, WIDTH, DIRECTIONS)
    x += product(encoded, tl.trans(weight), PRECISION)
    x += tl.load(b1 + unit, mask=unit < WIDTH, other=0.0)[None, :]
    return tl.maximum(x, 0.0).to(PRECISION)


@triton.jit
def upper_units(
    lower, w2, b2, unit, WIDTH: tl.constexpr, UNITS: tl.constexpr, PRECISION: tl.constexpr
):
    """What units of the second layer give, (BLOCK, SHARE) in ``PRECISION``, and their weights."""
    weight = matrix(w2, unit, tl.arange(0, UNITS), WIDTH, WIDTH).to(PRECISION)
    x = product(lower, tl.trans(weight), PRECISION)
    x += tl.load(b2 + unit, mask=unit < WIDTH, other=0.0)[None, :]
    return tl.maximum(x, 0.0).to(PRECISION), weight


@triton.jit
def output_weights(w3, unit, WIDTH: tl.constexpr):
    """The weights of units of the second layer for red, green and blue, (1, SHARE) each."""
    known = unit < WIDTH
    red = tl.load(w3 + unit, mask=known, other=0.0)
    green = tl.load(w3 + WIDTH + unit, mask=known, other=0.0)
    blue = tl.load(w3 + 2 * WIDTH + unit, mask=known, other=0.0)
    return red[None, :], green[None, :], blue[None, :]


@triton.jit
def to_upper(red, green, blue, upper, w3, unit, WIDTH: tl.constexpr):
    """From gradients of logits to those of units of the second layer, (BLOCK, SHARE)."""
    of_red, of_green, of_blue = output_weights(w3, unit, WIDTH)
    change = red[:, None] * of_red
    change += green[:, None] * of_green
    change += blue[:, None] * of_blue
    return tl.where(upper > 0.0, change, 0.0)


@triton.jit
def to_logits(colors, upstream, at, here):
    """Gradients of the logits: through the sigmoid."""
    red, green, blue = load_vectors(colors, at, here)
    to_red, to_green, to_blue = load_vectors(upstream, at, here)
    red = to_red * red * (1.0 - red)
    green = to_green * green * (1.0 - green)
    return red, green, to_blue * blue * (1.0 - blue)


@triton.jit(do_not_specialize=["places", "rays"])
def color_network_kernel(
    viewdirs,
    ray,
    first,
    octaves,
    w1,
    b1,
    v1,
    w2,
    b2,
    w3,
    b3,
    points,
    grid,
    axes,
    features,
    colors,
    places,
    rays,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    DIRECTIONS: tl.constexpr,
    ENCODED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
    SHARE: tl.constexpr,
    PRECISION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Features and colours of a block of samples; the colour is 0 in the padding."""
    begin = tl.program_id(0) * BLOCK
    place = begin + tl.arange(0, BLOCK)
    at = place.to(tl.int64) * 3
    listed = tl.load(first + rays)
    red = tl.zeros((BLOCK,), dtype=tl.float32)
    green = tl.zeros((BLOCK,), dtype=tl.float32)
    blue = tl.zeros((BLOCK,), dtype=tl.float32)
    if begin < listed:
        here = place < listed
        px, py, pz = load_vectors(points, at, here)
        found = rows_between(grid, axes, px, py, pz, here, CHANNELS, PADDED, BLOCK)
        channel = tl.arange(0, PADDED)
        wanted = here[:, None] & (channel < CHANNELS)[None, :]
        tl.store(features + place[:, None] * CHANNELS + channel[None, :], found, mask=wanted)
        encoded = encoded_directions(viewdirs, octaves, ray, place, here, DIRECTIONS, ENCODED)
        lower = lower_units(
            found, encoded, w1, b1, v1, CHANNELS, DIRECTIONS, WIDTH, UNITS, PRECISION
        )
        for start in tl.static_range(0, UNITS, SHARE):
            unit = start + tl.arange(0, SHARE)
            upper, _ = upper_units(lower, w2, b2, unit, WIDTH, UNITS, PRECISION)
            upper = upper.to(tl.float32)
            of_red, of_green, of_blue = output_weights(w3, unit, WIDTH)
            red += tl.sum(upper * of_red, axis=1)
            green += tl.sum(upper * of_green, axis=1)
            blue += tl.sum(upper * of_blue, axis=1)
        red = tl.where(here, sigmoid(red + tl.load(b3)), 0.0)
        green = tl.where(here, sigmoid(green + tl.load(b3 + 1)), 0.0)
        blue = tl.where(here, sigmoid(blue + tl.load(b3 + 2)), 0.0)
    store_vectors(colors, at, red, green, blue, place < places)


@triton.jit(do_not_specialize=["places", "rays"])
def color_samples_backward_kernel(
    viewdirs,
    ray,
    first,
    octaves,
    w1,
    b1,
    v1,
    w2,
    b2,
    w3,
    b3,
    features,
    colors,
    upstream,
    points,
    grid,
    axes,
    into_points,
    into_grid,
    places,
    rays,
    NEEDS_POINTS: tl.constexpr,
    NEEDS_GRID: tl.constexpr,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    DIRECTIONS: tl.constexpr,
    ENCODED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
    SHARE: tl.constexpr,
    PRECISION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradients of a block's features, scattered to the grid, and of its points; 0 in padding."""
    begin = tl.program_id(0) * BLOCK
    place = begin + tl.arange(0, BLOCK)
    at = place.to(tl.int64) * 3
    listed = tl.load(first + rays)
    if begin < listed:
        here = place < listed
        channel = tl.arange(0, PADDED)
        found = load_features(features, place, channel, here, CHANNELS)
        encoded = encoded_directions(viewdirs, octaves, ray, place, here, DIRECTIONS, ENCODED)
        lower = lower_units(
            found, encoded, w1, b1, v1, CHANNELS, DIRECTIONS, WIDTH, UNITS, PRECISION
        )
        red, green, blue = to_logits(colors, upstream, at, here)
        below = tl.zeros((BLOCK, UNITS), dtype=tl.float32)
        for start in tl.static_range(0, UNITS, SHARE):
            unit = start + tl.arange(0, SHARE)
            upper, weight = upper_units(lower, w2, b2, unit, WIDTH, UNITS, PRECISION)
            change = to_upper(red, green, blue, upper, w3, unit, WIDTH)
            below += product(change, weight, PRECISION)
        below = tl.where(lower > 0.0, below, 0.0)
        weight = matrix(w1, tl.arange(0, UNITS), channel, WIDTH, CHANNELS)
        px, py, pz = load_vectors(points, at, here)
        change = product(below, weight, PRECISION)
        gx, gy, gz = spread_rows(
            grid, axes, into_grid, change, px, py, pz, here, NEEDS_GRID, NEEDS_POINTS, CHANNELS
        )
        if NEEDS_POINTS:
            store_vectors(into_points, at, gx, gy, gz, place < places)
    else:
        if NEEDS_POINTS:
            nothing = tl.zeros((BLOCK,), dtype=tl.float32)
            store_vectors(into_points, at, nothing, nothing, nothing, place < places)


@triton.jit(do_not_specialize=["rays", "programs"])
def color_weights_backward_kernel(
    viewdirs,
    ray,
    first,
    octaves,
    w1,
    b1,
    v1,
    w2,
    b2,
    w3,
    b3,
    features,
    colors,
    upstream,
    into_w1,
    into_b1,
    into_v1,
    into_w2,
    into_b2,
    into_w3,
    into_b3,
    rays,
    programs,
    NEEDS_DIRECTIONS: tl.constexpr,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    DIRECTIONS: tl.constexpr,
    ENCODED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
    SHARE: tl.constexpr,
    PRECISION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """The weights' gradients through a share of the second layer, of every ``programs``-th block.

    What reaches the first layer through a share is added to what does through the others.
    """
    channel = tl.arange(0, PADDED)
    column = tl.arange(0, ENCODED)
    below_unit = tl.arange(0, UNITS)
    share = tl.program_id(0) // programs
    unit = share * SHARE + tl.arange(0, SHARE)
    of_features = tl.zeros((UNITS, PADDED), dtype=tl.float32)
    of_directions = tl.zeros((UNITS, ENCODED), dtype=tl.float32)
    of_lower_bias = tl.zeros((UNITS,), dtype=tl.float32)
    of_hidden = tl.zeros((SHARE, UNITS), dtype=tl.float32)
    of_upper_bias = tl.zeros((SHARE,), dtype=tl.float32)
    of_red = tl.zeros((SHARE,), dtype=tl.float32)
    of_green = tl.zeros((SHARE,), dtype=tl.float32)
    of_blue = tl.zeros((SHARE,), dtype=tl.float32)
    reds = tl.zeros((BLOCK,), dtype=tl.float32)
    greens = tl.zeros((BLOCK,), dtype=tl.float32)
    blues = tl.zeros((BLOCK,), dtype=tl.float32)
    listed = tl.load(first + rays)
    begin = (tl.program_id(0) % programs) * BLOCK
    while begin < listed:
        place = begin + tl.arange(0, BLOCK)
        here = place < listed
        found = load_features(features, place, channel, here, CHANNELS)
        encoded = encoded_directions(viewdirs, octaves, ray, place, here, DIRECTIONS, ENCODED)
        lower = lower_units(
            found, encoded, w1, b1, v1, CHANNELS, DIRECTIONS, WIDTH, UNITS, PRECISION
        )
        upper, weight = upper_units(lower, w2, b2, unit, WIDTH, UNITS, PRECISION)
        red, green, blue = to_logits(colors, upstream, place.to(tl.int64) * 3, here)
        reds += red
        greens += green
        blues += blue
        single = upper.to(tl.float32)
        of_red += tl.sum(red[:, None] * single, axis=0)
        of_green += tl.sum(green[:, None] * single, axis=0)
        of_blue += tl.sum(blue[:, None] * single, axis=0)
        change = to_upper(red, green, blue, upper, w3, unit, WIDTH)
        of_hidden += product(tl.trans(change), lower, PRECISION)
        of_upper_bias += tl.sum(change, axis=0)
        below = tl.where(lower > 0.0, product(change, weight, PRECISION), 0.0)
        of_features += product(tl.trans(below), found, PRECISION)
        of_lower_bias += tl.sum(below, axis=0)
        if NEEDS_DIRECTIONS:
            of_directions += product(tl.trans(below), encoded, PRECISION)
        begin += programs * BLOCK
    known = unit < WIDTH
    add_matrix(into_w1, of_features, below_unit, channel, WIDTH, CHANNELS)
    add_matrix(into_w2, of_hidden, unit, below_unit, WIDTH, WIDTH)
    tl.atomic_add(into_b1 + below_unit, of_lower_bias, mask=below_unit < WIDTH)
    tl.atomic_add(into_b2 + unit, of_upper_bias, mask=known)
    tl.atomic_add(into_w3 + unit, of_red, mask=known)
    tl.atomic_add(into_w3 + WIDTH + unit, of_green, mask=known)
    tl.atomic_add(into_w3 + 2 * WIDTH + unit, of_blue, mask=known)
    if share == 0:
        tl.atomic_add(into_b3, tl.sum(reds, 0))
        tl.atomic_add(into_b3 + 1, tl.sum(greens, 0))
        tl.atomic_add(into_b3 + 2, tl.sum(blues, 0))
    if NEEDS_DIRECTIONS:
        add_matrix(into_v1, of_directions, below_unit, column, WIDTH, DIRECTIONS)

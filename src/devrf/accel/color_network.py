"""The colour network on listed samples: features, layers and sigmoid of a block in one program.

With features f and what the first layer gives of a ray's direction, d, RGB = sigmoid(w₃·h₂ + b₃),
h₂ = relu(w₂·h₁ + b₂) and h₁ = relu(w₁·f + b₁ + d): so weights are named.

The backward pass computes the layers again. What the weights of the first two layers get is left to
matrix products of its own: a program's registers do not hold that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import blocks, gradient_target, launch, load_vectors, sigmoid, store_vectors
from devrf.accel.color_layers import (
    BLOCK,
    SHARE,
    directions_kernel,
    load_tile,
    lower_units,
    output_weights,
    padded,
    product,
    store_tile,
    upper_units,
)
from devrf.accel.trilinear import rows_between, spread_rows


class ListedColors(torch.autograd.Function):
    """As devrf.ops.color_network.listed_colors."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        grid: Tensor,
        axes: Tensor,
        viewdirs: Tensor,
        octaves: Tensor,
        ray: Tensor,
        first: Tensor,
        precision: torch.dtype,
        accumulated: Sequence[Tensor | None],
        *weights: Tensor,
    ) -> Tensor:
        """Colours (S, 3) of S places; ``weights`` in the order of ``ColorNetwork``.

        ``accumulated``: the gradients that grid and weights have already.
        """
        points, grid, viewdirs, ray = (t.contiguous() for t in (points, grid, viewdirs, ray))
        w1, b1, v1, w2, b2, w3, b3 = (weight.contiguous() for weight in weights)
        layers, rays = (w1, b1, w2, b2, w3, b3), len(viewdirs)
        ctx.sizes = {
            "CHANNELS": grid.shape[3],
            "PADDED": padded(grid.shape[3]),
            "WIDTH": len(b2),
            "UNITS": padded(len(b2)),
        }
        encoded = points.new_empty(rays, v1.shape[1], dtype=precision)
        from_ray = encoded.new_empty(rays, len(b2))
        launch(
            directions_kernel,
            blocks(rays, BLOCK.value),
            *(viewdirs, octaves, v1, encoded, from_ray, rays),
            DIRECTIONS=v1.shape[1],
            ENCODED=padded(v1.shape[1]),
            WIDTH=len(b2),
            UNITS=padded(len(b2)),
        )
        features, colors = points.new_empty(len(points), grid.shape[3]), torch.empty_like(points)
        launch(
            color_network_kernel,
            blocks(len(points), BLOCK.value),
            *(points, grid, axes, from_ray, ray, first, *layers, features, colors),
            *(len(points), rays),
            **ctx.sizes,
        )
        known = points, grid, axes, from_ray, ray, first, *layers
        ctx.save_for_backward(*known, features, colors, encoded, v1)
        ctx.accumulated = accumulated
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Any, ...]:
        *known, features, colors, encoded, v1 = ctx.saved_tensors
        points, grid, _, _, ray, first, w1, b1, w2, b2, w3, b3 = known
        leaves = grid, w1, b1, v1, w2, b2, w3, b3
        needs = ctx.needs_input_grad[1], *ctx.needs_input_grad[9:]
        targets = [*map(gradient_target, leaves, needs, ctx.accumulated)]
        (into_grid, _, adds), of_w1, of_b1, of_v1, of_w2, *of_others = targets
        moves, learns = ctx.needs_input_grad[0], any(added for *_, added in targets[1:])
        moved, rows = torch.empty_like(points), len(points) if learns else 0
        lower, to_lower, to_upper = (encoded.new_empty(rows, len(b2)) for _ in range(3))
        # A weight that is not learned beside others that are must not be added to.
        sums = (into if added else torch.empty_like(into) for into, _, added in (of_b1, *of_others))
        launch(
            color_backward_kernel,
            blocks(len(points), BLOCK.value),
            *(*known, features, colors, upstream.contiguous(), moved, into_grid),
            *(lower, to_lower, to_upper, *sums, len(points), len(first) - 1),
            NEEDS_POINTS=moves,
            NEEDS_GRID=adds,
            NEEDS_WEIGHTS=learns,
            **ctx.sizes,
        )
        if of_w1[2]:
            of_w1[0].add_(to_lower.t() @ features.to(to_lower.dtype))
        if of_v1[2]:
            of_v1[0].add_(to_lower.t() @ encoded.index_select(0, ray))
        if of_w2[2]:
            of_w2[0].add_(to_upper.t() @ lower)
        grid_gradient, *gradients = (gradient for _, gradient, _ in targets)
        return moved if moves else None, grid_gradient, *[None] * 7, *gradients


listed_colors = ListedColors.apply


@triton.jit(do_not_specialize=["places", "rays"])
def color_network_kernel(
    points,
    grid,
    axes,
    from_ray,
    ray,
    first,
    w1,
    b1,
    w2,
    b2,
    w3,
    b3,
    features,
    colors,
    places,
    rays,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
):
    """Features and colours of a block of samples, 0 in the padding."""
    begin = tl.program_id(0) * BLOCK
    place = begin + tl.arange(0, BLOCK)
    at = place.to(tl.int64) * 3
    listed = tl.load(first + rays)
    red = tl.zeros((BLOCK,), dtype=tl.float32)
    green = tl.zeros((BLOCK,), dtype=tl.float32)
    blue = tl.zeros((BLOCK,), dtype=tl.float32)
    if begin < listed:
        mask = place < listed
        px, py, pz = load_vectors(points, at, mask)
        feature = rows_between(grid, axes, px, py, pz, mask, CHANNELS, PADDED, BLOCK)
        store_tile(features, place, tl.arange(0, PADDED), places, feature, CHANNELS)
        sample_ray = tl.load(ray + place, mask=mask, other=0)
        lower = lower_units(feature, from_ray, sample_ray, w1, b1, CHANNELS, WIDTH, UNITS)
        for start in range(0, UNITS, SHARE):
            unit = start + tl.arange(0, SHARE)
            upper, _ = upper_units(lower, w2, b2, unit, WIDTH)
            upper = upper.to(tl.float32)
            of_red, of_green, of_blue = output_weights(w3, unit, WIDTH)
            red += tl.sum(upper * of_red, axis=1)
            green += tl.sum(upper * of_green, axis=1)
            blue += tl.sum(upper * of_blue, axis=1)
        red = tl.where(mask, sigmoid(red + tl.load(b3)), 0.0)
        green = tl.where(mask, sigmoid(green + tl.load(b3 + 1)), 0.0)
        blue = tl.where(mask, sigmoid(blue + tl.load(b3 + 2)), 0.0)
    else:
        nothing = tl.zeros((BLOCK, PADDED), dtype=tl.float32)
        store_tile(features, place, tl.arange(0, PADDED), places, nothing, CHANNELS)
    store_vectors(colors, at, red, green, blue, place < places)


@triton.jit(do_not_specialize=["places", "rays"])
def color_backward_kernel(
    points,
    grid,
    axes,
    from_ray,
    ray,
    first,
    w1,
    b1,
    w2,
    b2,
    w3,
    b3,
    features,
    colors,
    upstream,
    into_points,
    into_grid,
    lowers,
    to_lowers,
    to_uppers,
    into_b1,
    into_b2,
    into_w3,
    into_b3,
    places,
    rays,
    NEEDS_POINTS: tl.constexpr,
    NEEDS_GRID: tl.constexpr,
    NEEDS_WEIGHTS: tl.constexpr,
    CHANNELS: tl.constexpr,
    PADDED: tl.constexpr,
    WIDTH: tl.constexpr,
    UNITS: tl.constexpr,
):
    """Gradients of a block's features, scattered to the grid, and of its points; 0 in padding.

    With ``NEEDS_WEIGHTS`` also what the first layer gives, and the gradients of that and of what
    the second gives; the gradients of the biases and of the last layer are added up here.
    """
    begin = tl.program_id(0) * BLOCK
    place = begin + tl.arange(0, BLOCK)
    at = place.to(tl.int64) * 3
    listed = tl.load(first + rays)
    mask = place < listed
    below_unit = tl.arange(0, UNITS)
    gx = tl.zeros((BLOCK,), dtype=tl.float32)
    gy = tl.zeros((BLOCK,), dtype=tl.float32)
    gz = tl.zeros((BLOCK,), dtype=tl.float32)
    red, green, blue = load_vectors(colors, at, mask)
    to_red, to_green, to_blue = load_vectors(upstream, at, mask)
    red = to_red * red * (1.0 - red)
    green = to_green * green * (1.0 - green)
    blue = to_blue * blue * (1.0 - blue)
    if begin < listed:
        channel = tl.arange(0, PADDED)
        feature = load_tile(features, place, channel, listed, CHANNELS)
        sample_ray = tl.load(ray + place, mask=mask, other=0)
        lower = lower_units(feature, from_ray, sample_ray, w1, b1, CHANNELS, WIDTH, UNITS)
        below = tl.zeros((BLOCK, UNITS), dtype=tl.float32)
        for start in range(0, UNITS, SHARE):
            unit = start + tl.arange(0, SHARE)
            upper, weight = upper_units(lower, w2, b2, unit, WIDTH)
            of_red, of_green, of_blue = output_weights(w3, unit, WIDTH)
            change = red[:, None] * of_red
            change += green[:, None] * of_green
            change += blue[:, None] * of_blue
            change = tl.where(upper > 0.0, change, 0.0)
            below += product(change, weight, lower.dtype)
            if NEEDS_WEIGHTS:
                store_tile(to_uppers, place, unit, places, change, WIDTH)
                single, known = upper.to(tl.float32), unit < WIDTH
                tl.atomic_add(into_b2 + unit, tl.sum(change, 0), mask=known)
                tl.atomic_add(into_w3 + unit, tl.sum(red[:, None] * single, 0), mask=known)
                of_units = tl.sum(green[:, None] * single, 0)
                tl.atomic_add(into_w3 + WIDTH + unit, of_units, mask=known)
                of_units = tl.sum(blue[:, None] * single, 0)
                tl.atomic_add(into_w3 + 2 * WIDTH + unit, of_units, mask=known)
        below = tl.where(lower > 0.0, below, 0.0)
        if NEEDS_WEIGHTS:
            tl.atomic_add(into_b1 + below_unit, tl.sum(below, 0), mask=below_unit < WIDTH)
            tl.atomic_add(into_b3, tl.sum(red, 0))
            tl.atomic_add(into_b3 + 1, tl.sum(green, 0))
            tl.atomic_add(into_b3 + 2, tl.sum(blue, 0))
            store_tile(lowers, place, below_unit, places, lower, WIDTH)
            store_tile(to_lowers, place, below_unit, places, below, WIDTH)
        weight = load_tile(w1, below_unit, channel, WIDTH, CHANNELS)
        px, py, pz = load_vectors(points, at, mask)
        change = product(below, weight, lower.dtype)
        gx, gy, gz = spread_rows(
            grid, axes, into_grid, change, px, py, pz, mask, NEEDS_GRID, NEEDS_POINTS, CHANNELS
        )
    else:
        if NEEDS_WEIGHTS:
            nothing = tl.zeros((BLOCK, UNITS), dtype=lowers.dtype.element_ty)
            store_tile(lowers, place, below_unit, places, nothing, WIDTH)
            store_tile(to_lowers, place, below_unit, places, nothing, WIDTH)
            store_tile(to_uppers, place, below_unit, places, nothing, WIDTH)
    if NEEDS_POINTS:
        store_vectors(into_points, at, gx, gy, gz, place < places)

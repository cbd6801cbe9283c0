"""Compositing and its backward pass: one program for each ray.

Sums stay within a ray, so that float32 suffices. The sum over the samples before one is accumulated
from its neighbour on, never as an inclusive sum minus the sample itself: behind an opaque sample
that difference would cancel.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.accel.blocks import (
    LANES,
    PADDING,
    launch,
    load_vectors,
    opacity,
    padding_places,
    padding_programs,
    store_vectors,
)


class Composite(torch.autograd.Function):
    """As devrf.ops.compositing.composite_segments."""

    @staticmethod
    def forward(ctx: Any, depth: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        depth, first = depth.contiguous(), first.contiguous()
        rays, places = len(first) - 1, len(depth)
        weights, transmittance = torch.empty_like(depth), torch.empty_like(depth)
        end = depth.new_empty(rays)
        launch(
            composite_kernel,
            rays + padding_programs(places),
            *(depth, first, weights, transmittance, end, rays, places),
            num_warps=1,
        )
        ctx.save_for_backward(first, weights, transmittance, end)
        return weights, end

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, weights_gradient: Tensor, end_gradient: Tensor) -> tuple[Tensor, None]:
        first, weights, transmittance, end = ctx.saved_tensors
        into, rays, places = torch.empty_like(weights), len(end), len(weights)
        known = (first, weights, transmittance, end)
        upstream = (weights_gradient.contiguous(), end_gradient.contiguous())
        launch(
            composite_backward_kernel,
            rays + padding_programs(places),
            *(*known, *upstream, into, rays, places),
            num_warps=1,
        )
        return into, None


composite_segments = Composite.apply


class CompositeColors(torch.autograd.Function):
    """As devrf.ops.compositing.composite_colors."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        tensors = tuple(tensor.contiguous() for tensor in tensors)
        weights, colors, _, first, _, background = tensors
        rays = len(first) - 1
        ctx.apart = 0 if background.dim() == 1 else 3
        image, depth = colors.new_empty(rays, 3), colors.new_empty(rays)
        launch(colors_kernel, rays, *tensors, image, depth, ctx.apart, num_warps=1)
        ctx.save_for_backward(weights, colors, first, background)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(depth)
        return image, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: None) -> tuple[Tensor | None, ...]:
        weights, colors, first, background = ctx.saved_tensors
        rays, places = len(first) - 1, len(weights)
        to_weights, to_colors = torch.empty_like(weights), torch.empty_like(colors)
        to_transmittance = colors.new_empty(rays)
        launch(
            colors_backward_kernel,
            rays + padding_programs(places),
            *(weights, colors, first, background, upstream.contiguous()),
            *(to_weights, to_colors, to_transmittance, rays, places, ctx.apart),
            num_warps=1,
        )
        return to_weights, to_colors, None, None, to_transmittance, None


composite_colors = CompositeColors.apply


@triton.jit(do_not_specialize=["rays", "places"])
def composite_kernel(depth, first, weights, transmittance, ends, rays, places):
    """w_i = T_i·α_i with T_i = exp(−Σ_{j<i} τ_j), and T_end; w is 0 in the padding."""
    ray = tl.program_id(0)
    if ray < rays:
        start = tl.load(first + ray)
        stop = tl.load(first + ray + 1)
        lane = tl.arange(0, LANES)
        gone = 0.0
        while start < stop:
            at = start + lane
            mask = at < stop
            tau = tl.load(depth + at, mask=mask, other=0.0)
            previous = tl.load(depth + at - 1, mask=mask & (lane > 0), other=0.0)
            left = tl.exp(-(gone + tl.cumsum(previous, 0)))
            tl.store(transmittance + at, left, mask=mask)
            tl.store(weights + at, left * opacity(tau), mask=mask)
            gone += tl.sum(tau, 0)
            start += LANES
        tl.store(ends + ray, tl.exp(-gone))
    else:
        place, empty = padding_places(ray - rays, tl.load(first + rays), places)
        tl.store(weights + place, tl.zeros((PADDING,), dtype=tl.float32), mask=empty)


@triton.jit(do_not_specialize=["rays", "places"])
def composite_backward_kernel(
    first, weights, transmittance, ends, weights_gradient, end_gradient, into, rays, places
):
    """∂/∂τ_i = g_i·T_{i+1} − Σ_{j>i} g_j·w_j − g_end·T_end, from the back to the front."""
    ray = tl.program_id(0)
    if ray < rays:
        begin = tl.load(first + ray)
        stop = tl.load(first + ray + 1)
        lane = tl.arange(0, LANES)
        last = tl.load(end_gradient + ray) * tl.load(ends + ray)
        start = begin + (tl.cdiv(stop - begin, LANES) - 1) * LANES
        while start >= begin:
            at = start + lane
            mask = at < stop
            gradient = tl.load(weights_gradient + at, mask=mask, other=0.0)
            weight = tl.load(weights + at, mask=mask, other=0.0)
            left = tl.load(transmittance + at, mask=mask, other=0.0) - weight
            beyond = mask & (at + 1 < stop) & (lane < LANES - 1)
            follower = tl.load(weights_gradient + at + 1, mask=beyond, other=0.0)
            follower *= tl.load(weights + at + 1, mask=beyond, other=0.0)
            behind = last + tl.cumsum(follower, 0, reverse=True)
            tl.store(into + at, gradient * left - behind, mask=mask)
            last += tl.sum(gradient * weight, 0)
            start -= LANES
    else:
        place, empty = padding_places(ray - rays, tl.load(first + rays), places)
        tl.store(into + place, tl.zeros((PADDING,), dtype=tl.float32), mask=empty)


@triton.jit(do_not_specialize=["apart"])
def colors_kernel(weights, colors, distance, first, transmittance, background, image, depth, apart):
    """Σ w_i·c_i + T_end·background and Σ w_i·z_i / Σ w_i of a ray.

    ``apart`` is 3 where each ray has a background of its own, else 0.
    """
    ray = tl.program_id(0).to(tl.int64)
    start = tl.load(first + ray)
    stop = tl.load(first + ray + 1)
    lane = tl.arange(0, LANES)
    red = 0.0
    green = 0.0
    blue = 0.0
    reached = 0.0
    mass = 0.0
    while start < stop:
        at = start + lane
        mask = at < stop
        weight = tl.load(weights + at, mask=mask, other=0.0)
        r, g, b = load_vectors(colors, at * 3, mask)
        red += tl.sum(weight * r, 0)
        green += tl.sum(weight * g, 0)
        blue += tl.sum(weight * b, 0)
        reached += tl.sum(weight * tl.load(distance + at, mask=mask, other=0.0), 0)
        mass += tl.sum(weight, 0)
        start += LANES
    left = tl.load(transmittance + ray)
    behind = background + ray * apart
    tl.store(image + ray * 3, red + left * tl.load(behind))
    tl.store(image + ray * 3 + 1, green + left * tl.load(behind + 1))
    tl.store(image + ray * 3 + 2, blue + left * tl.load(behind + 2))
    tl.store(depth + ray, reached / tl.maximum(mass, 1e-6))


@triton.jit(do_not_specialize=["rays", "places", "apart"])
def colors_backward_kernel(
    weights,
    colors,
    first,
    background,
    upstream,
    into_weights,
    into_colors,
    into_transmittance,
    rays,
    places,
    apart,
):
    """g·c to the weights, g·w to the colours, g·background to the transmittance."""
    program = tl.program_id(0)
    if program < rays:
        ray = program.to(tl.int64)
        red = tl.load(upstream + ray * 3)
        green = tl.load(upstream + ray * 3 + 1)
        blue = tl.load(upstream + ray * 3 + 2)
        behind = background + ray * apart
        change = red * tl.load(behind) + green * tl.load(behind + 1) + blue * tl.load(behind + 2)
        tl.store(into_transmittance + ray, change)
        start = tl.load(first + ray)
        stop = tl.load(first + ray + 1)
        lane = tl.arange(0, LANES)
        while start < stop:
            at = start + lane
            mask = at < stop
            weight = tl.load(weights + at, mask=mask, other=0.0)
            r, g, b = load_vectors(colors, at * 3, mask)
            tl.store(into_weights + at, red * r + green * g + blue * b, mask=mask)
            store_vectors(into_colors, at * 3, red * weight, green * weight, blue * weight, mask)
            start += LANES
    else:
        place, empty = padding_places(program - rays, tl.load(first + rays), places)
        nothing = tl.zeros((PADDING,), dtype=tl.float32)
        tl.store(into_weights + place, nothing, mask=empty)
        store_vectors(into_colors, place * 3, nothing, nothing, nothing, empty)

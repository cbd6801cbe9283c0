"""The photometric terms: one program for each ray, the sum over rays in a second launch."""

from __future__ import annotations

from collections.abc import Sequence
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
    padding_places,
    padding_programs,
    store_vectors,
)

# A transmittance is at least so far from 0 and 1 in the entropy; as in devrf.ops.photometric.
NEAREST: tl.constexpr = tl.constexpr(1e-6)


class Photometric(torch.autograd.Function):
    """As devrf.ops.photometric.photometric_sum: total; terms; mean opacity and coverage."""

    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor | None, weights: Sequence[float], *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``tensors``: image, transmittance, weights and colours of samples, first, truth."""
        tensors = tuple(tensor.contiguous() for tensor in tensors)
        image, transmittance = tensors[:2]
        rays, parts = len(image), image.new_empty(len(image), 7)
        # The transmittance stands in for a missing alpha mask, which is not read.
        known = *tensors, transmittance if alpha is None else alpha.contiguous()
        ctx.weights, ctx.has_alpha = weights, alpha is not None
        launch(
            photometric_kernel,
            rays,
            *(*known, parts, *weights, rays),
            ALPHA=ctx.has_alpha,
            num_warps=1,
        )
        sums = parts.sum(dim=0)
        total, terms, means = sums[4], sums[:4], sums[5:]
        ctx.save_for_backward(*known)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(terms, means)
        return total, terms, means

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor, *_: None) -> tuple[Tensor | None, ...]:
        image, transmittance, _, color, *_ = known = ctx.saved_tensors
        to_image, to_transmittance = torch.empty_like(image), torch.empty_like(transmittance)
        to_color = torch.empty_like(color)
        rays, places = len(image), len(color)
        launch(
            photometric_backward_kernel,
            rays + padding_programs(places),
            *(*known, upstream.contiguous(), to_image, to_transmittance, to_color),
            *(*ctx.weights, rays, places),
            ALPHA=ctx.has_alpha,
            num_warps=1,
        )
        return None, None, to_image, to_transmittance, None, to_color, None, None


photometric_sum = Photometric.apply


@triton.jit
def entropy(p):
    """−(p log p + (1 − p) log(1 − p))."""
    return -(p * tl.log(p) + (1.0 - p) * tl.log(1.0 - p))


@triton.jit(do_not_specialize=["rays"])
def photometric_kernel(
    image,
    transmittance,
    sample_weight,
    sample_color,
    first,
    truth,
    alpha,
    parts,
    of_color,
    of_samples,
    of_entropy,
    of_mask,
    rays,
    ALPHA: tl.constexpr,
):
    """A ray's share of each term, of their weighted sum, and of mean opacity and alpha mask."""
    ray = tl.program_id(0).to(tl.int64)
    red = tl.load(truth + ray * 3)
    green = tl.load(truth + ray * 3 + 1)
    blue = tl.load(truth + ray * 3 + 2)
    off_red = tl.load(image + ray * 3) - red
    off_green = tl.load(image + ray * 3 + 1) - green
    off_blue = tl.load(image + ray * 3 + 2) - blue
    share = 1.0 / rays
    color = share * (off_red * off_red + off_green * off_green + off_blue * off_blue) / 3.0
    stop = tl.load(first + ray + 1)
    start = tl.load(first + ray)
    lane = tl.arange(0, LANES)
    missed = 0.0
    while start < stop:
        at = start + lane
        mask = at < stop
        r, g, b = load_vectors(sample_color, at * 3, mask)
        weight = tl.load(sample_weight + at, mask=mask, other=0.0)
        r -= red
        g -= green
        b -= blue
        missed += tl.sum(weight * (r * r + g * g + b * b), 0)
        start += LANES
    missed = missed * share
    left = tl.load(transmittance + ray)
    unsure = share * entropy(tl.minimum(tl.maximum(left, NEAREST), 1.0 - NEAREST))
    bare = 0.0
    covered = 0.0
    if ALPHA:
        covered = tl.load(alpha + ray)
        bare = left - (1.0 - covered)
    mask_error = share * bare * bare
    part = parts + ray * 7
    tl.store(part, color)
    tl.store(part + 1, missed)
    tl.store(part + 2, unsure)
    tl.store(part + 3, mask_error)
    total = of_color * color + of_samples * missed + of_entropy * unsure + of_mask * mask_error
    tl.store(part + 4, total)
    tl.store(part + 5, share * (1.0 - left))
    tl.store(part + 6, share * covered)


@triton.jit(do_not_specialize=["rays", "places"])
def photometric_backward_kernel(
    image,
    transmittance,
    sample_weight,
    sample_color,
    first,
    truth,
    alpha,
    upstream,
    into_image,
    into_transmittance,
    into_color,
    of_color,
    of_samples,
    of_entropy,
    of_mask,
    rays,
    places,
    ALPHA: tl.constexpr,
):
    """Gradients of a ray's colour and transmittance, and of its samples' colours."""
    program = tl.program_id(0)
    if program < rays:
        ray = program.to(tl.int64)
        share = tl.load(upstream) / rays
        red = tl.load(truth + ray * 3)
        green = tl.load(truth + ray * 3 + 1)
        blue = tl.load(truth + ray * 3 + 2)
        slope = of_color * share * 2.0 / 3.0
        tl.store(into_image + ray * 3, slope * (tl.load(image + ray * 3) - red))
        tl.store(into_image + ray * 3 + 1, slope * (tl.load(image + ray * 3 + 1) - green))
        tl.store(into_image + ray * 3 + 2, slope * (tl.load(image + ray * 3 + 2) - blue))
        left = tl.load(transmittance + ray)
        p = tl.minimum(tl.maximum(left, NEAREST), 1.0 - NEAREST)
        free = (left >= NEAREST) & (left <= 1.0 - NEAREST)
        change = tl.where(free, of_entropy * share * (tl.log(1.0 - p) - tl.log(p)), 0.0)
        if ALPHA:
            change += of_mask * share * 2.0 * (left - (1.0 - tl.load(alpha + ray)))
        tl.store(into_transmittance + ray, change)
        start = tl.load(first + ray)
        stop = tl.load(first + ray + 1)
        lane = tl.arange(0, LANES)
        while start < stop:
            at = start + lane
            mask = at < stop
            r, g, b = load_vectors(sample_color, at * 3, mask)
            steep = 2.0 * of_samples * share * tl.load(sample_weight + at, mask=mask, other=0.0)
            r = steep * (r - red)
            g = steep * (g - green)
            b = steep * (b - blue)
            store_vectors(into_color, at * 3, r, g, b, mask)
            start += LANES
    else:
        place, empty = padding_places(program - rays, tl.load(first + rays), places)
        nothing = tl.zeros((PADDING,), dtype=tl.float32)
        store_vectors(into_color, place * 3, nothing, nothing, nothing, empty)

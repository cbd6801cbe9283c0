"""The photometric terms of a batch, weighted, and their gradients; a thread looks at one ray.

See docs/method.md#photometric-losses.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import warp as wp
from torch import Tensor

from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.compositing import behind, first_of
from devrf.kernels.runtime import launch, row_type
from devrf.ops.march import Samples
from devrf.ops.photometric import NEAREST, TERMS

# A ray's part of Σ weight · term, of each term, and its opacity and alpha.
Part = row_type(len(TERMS) + 3)


def photometric(
    samples: Samples,
    color: Tensor,
    background: Tensor,
    image: Tensor,
    truth: Tensor,
    alpha: Tensor | None,
    weights: Mapping[str, float],
    per_pixel: int = 1,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Σ weight · term () by kernels, and by name the values () of the terms, without gradients.

    With them the rays' mean ``opacity`` and, of alpha masks, their ``coverage``. The gradients are
    those of samples, their colours and the background: Ĉ's own graph is not taken.

    Args:
        samples: of the R rays.
        color: (K, 3) c of the samples.
        background: (3,) or (R, 3).
        image: (R, 3) Ĉ, composited of these.
        truth: (R, 3) C.
        alpha: (R,) A, or None.
        weights: of some of the terms of :mod:`devrf.ops.photometric`.
        per_pixel: the rays of a pixel, which follow one another and have the same C and A.
    """
    factors = wp.vec4(*(weights.get(name, 0.0) for name in TERMS))
    device, rays = color.device, len(samples.transmittance)
    learned = [samples.weight, color, samples.transmittance]
    learned += [background] if background.requires_grad else []
    mask = truth.new_empty(0) if alpha is None else alpha
    given = [samples.weight, color, samples.transmittance, background.view(-1, 3), image]
    given += [samples.stop, truth, mask]
    parts = torch.empty(rays, len(TERMS) + 3, device=device)
    gradients = [torch.empty_like(each) for each in learned]
    results = gradients if background.requires_grad else [*gradients, truth.new_empty(0, 3)]
    inputs = [factors, per_pixel, *(each.detach().contiguous() for each in given), parts, *results]
    launch(photometric_kernel, rays, inputs, device)
    sum_of_terms, *values = parts.mean(dim=0).unbind()
    (total,) = with_adjoint(
        (sum_of_terms,), learned, lambda gradient: torch._foreach_mul(gradients, gradient)
    )
    by_name = dict(zip((*TERMS, "opacity", "coverage"), values, strict=True))
    named = [*weights, "opacity"] + ["coverage"] * (alpha is not None)
    return total, {name: by_name[name] for name in named}


@wp.kernel(module="unique", enable_backward=False)
def photometric_kernel(
    first: int,
    factors: wp.vec4,
    per_pixel: int,
    weight: wp.array(dtype=float),
    color: wp.array(dtype=wp.vec3),
    transmittance: wp.array(dtype=float),
    background: wp.array(dtype=wp.vec3),
    image: wp.array(dtype=wp.vec3),
    stops: wp.array(dtype=wp.int64),
    truth: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=float),
    result: wp.array(dtype=Part),
    of_weight: wp.array(dtype=float),
    of_color: wp.array(dtype=wp.vec3),
    of_transmittance: wp.array(dtype=float),
    of_background: wp.array(dtype=wp.vec3),
):
    """A ray's part of each term that counts, and of their weighted sum; the sum's gradients.

    These are of what the image is composited of.
    """
    ray = first + wp.tid()
    rays = float(transmittance.shape[0])
    end = transmittance[ray]
    missed = wp.vec3()
    beside = float(0.0)
    begin = ray - ray % per_pixel
    for other in range(begin, begin + per_pixel):
        missed += (image[other] - truth[ray]) / float(per_pixel)
        beside += transmittance[other] / float(per_pixel)
    of_image = (factors[0] * 2.0 / 3.0 / rays) * missed
    of_apart = factors[1] * 2.0 / rays
    by_sample = float(0.0)
    for k in range(first_of(stops, ray), int(stops[ray])):
        apart = color[k] - truth[ray]
        by_sample += weight[k] * wp.dot(apart, apart)
        of_weight[k] = wp.dot(of_image, color[k])
        of_color[k] = weight[k] * (of_image + of_apart * apart)
    of_end = wp.dot(of_image, behind(background, ray))
    if of_background.shape[0] > 0:
        of_background[ray] = end * of_image
    p = wp.clamp(end, wp.static(NEAREST), wp.static(1.0 - NEAREST))
    if p == end:
        of_end += factors[2] / rays * (wp.log(1.0 - p) - wp.log(p))
    part = Part()
    part[1] = wp.dot(missed, missed) / 3.0
    part[2] = by_sample
    part[3] = -(p * wp.log(p) + (1.0 - p) * wp.log(1.0 - p))
    part[5] = 1.0 - end
    if alpha.shape[0] > 0:
        beside -= 1.0 - alpha[ray]
        of_end += factors[3] * 2.0 / rays * beside
        part[4] = beside * beside
        part[6] = alpha[ray]
    for term in range(4):
        part[0] += factors[term] * part[1 + term]
    result[ray] = part
    of_transmittance[ray] = of_end

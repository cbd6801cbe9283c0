"""The photometric terms of a batch and their weighted sum, in one pass over its rays.

See docs/method.md#photometric-losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.ops.compositing import sum_segments
from devrf.ops.dispatch import accelerated

# The order of terms and of their weights.
TERMS = ("color", "per_sample_color", "entropy", "alpha_mask")
# A transmittance is at least so far from 0 and 1 in the entropy.
NEAREST = 1e-6


class PhotometricSum(NamedTuple):
    """What a batch's rays lack of the truth.

    Attributes:
        total: () Σ weight · term; differentiable once.
        terms: (4,) the terms in the order of :data:`TERMS`; not differentiable.
        opacity: () mean 1 − T_end; not differentiable.
        coverage: () mean A, or None.
    """

    total: Tensor
    terms: Tensor
    opacity: Tensor
    coverage: Tensor | None


def photometric_sum(
    image: Tensor,
    transmittance: Tensor,
    sample_weight: Tensor,
    sample_color: Tensor,
    first: Tensor,
    truth: Tensor,
    alpha: Tensor | None,
    weights: Sequence[float],
) -> PhotometricSum:
    """Four terms of R rays, each a mean over rays, and Σ weight · term.

    ``mean |Ĉ − C|²`` over rays and channels; ``(1/R) Σ_i w_i |c_i − C|²``; the mean entropy
    ``−(p log p + (1 − p) log(1 − p))`` of p = T_end; the mean ``(T_end − (1 − A))²``, 0 without A.

    Args:
        image: (R, 3) Ĉ.
        transmittance: (R,) T_end.
        sample_weight: (K,) w of the samples; it gets no gradient.
        sample_color: (K, 3) c of the samples.
        first: (R + 1,) where each ray's samples begin; places from first[R] on are padding.
        truth: (R, 3) C.
        alpha: (R,) A, or None.
        weights: of the four terms, in the order of :data:`TERMS`.
    """
    floats = image, transmittance, sample_weight, sample_color
    if kernels := accelerated("photometric", *floats, truth):
        total, terms, seen = kernels.photometric_sum(*floats, first, truth, alpha, weights)
        return PhotometricSum(total, terms, seen[0], None if alpha is None else seen[1])
    rays = len(image)
    place = torch.arange(len(sample_weight), device=first.device)
    ray = torch.searchsorted(first[1:].contiguous(), place, right=True).clamp(max=rays - 1)
    missed = (sample_color - truth.index_select(0, ray)).square().sum(dim=1, keepdim=True)
    p = transmittance.clamp(NEAREST, 1 - NEAREST)
    matte = p.new_zeros(()) if alpha is None else (transmittance - (1 - alpha)).square().mean()
    terms = torch.stack(
        [
            (image - truth).square().mean(),
            sum_segments(sample_weight.detach(), missed, first).sum() / rays,
            -(p * p.log() + (1 - p) * torch.log1p(-p)).mean(),
            matte,
        ]
    )
    total = sum(weight * term for weight, term in zip(weights, terms.unbind(), strict=True))
    assert isinstance(total, Tensor)
    covered = None if alpha is None else alpha.mean()
    return PhotometricSum(total, terms.detach(), 1 - transmittance.detach().mean(), covered)

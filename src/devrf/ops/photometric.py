"""The photometric terms of a batch and their weighted sum, in one pass over its rays.

See docs/method.md#photometric-losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.ops.compositing import firsts, running_sum
from devrf.ops.dispatch import accelerated

# The order of terms and of their weights.
TERMS = ("color", "per_sample_color", "entropy", "alpha_mask")
# A transmittance is at least so far from 0 and 1 in the entropy.
NEAREST = 1e-6


def color_error(image: Tensor, truth: Tensor) -> Tensor:
    """Mean |Ĉ − C|² over rays and channels, of Ĉ and C (R, 3)."""
    return torch.nn.functional.mse_loss(image, truth)


def per_sample_color(weight: Tensor, color: Tensor, ray: Tensor, truth: Tensor) -> Tensor:
    """(1/R) Σ_i sg(w_i) |c_i − C|²: each sample by itself should have the pixel's colour.

    Args:
        weight: (K,) w of the samples, 0 in padding; it gets no gradient.
        color: (K, 3) c of the samples.
        ray: (K,) int64, their rays.
        truth: (R, 3) C.
    """
    error = (color - truth.index_select(0, ray)).square().sum(dim=1)
    return (weight.detach() * error).sum() / len(truth)


def background_entropy(transmittance: Tensor) -> Tensor:
    """Mean −(p log p + (1 − p) log(1 − p)), p = T_end (R,): a ray hits something or nothing."""
    p = transmittance.clamp(NEAREST, 1 - NEAREST)
    return -(p * p.log() + (1 - p) * torch.log1p(-p)).mean()


def distortion(weight: Tensor, distance: Tensor, ray: Tensor, rays: int) -> Tensor:
    """(1/R) Σ_i Σ_j w_i w_j |s_i − s_j| over the pairs of samples of each ray.

    mip-NeRF 360's distortion loss without its term of single samples, whose steps are equal here.

    Args:
        weight: (K,) w of the samples, 0 in padding.
        distance: (K,) s of the samples, ascending along each ray.
        ray: (K,) int64, ascending.
        rays: R.
    """
    first = firsts(ray, rays)[ray]
    before = (running_sum(weight), running_sum(weight * distance))
    mass, reached = ((sums[:-1] - sums[first]).to(weight.dtype) for sums in before)
    total: Tensor = (weight * (distance * mass - reached)).sum()
    return 2 * total / rays


def alpha_mask_error(transmittance: Tensor, alpha: Tensor | None) -> Tensor:
    """Mean (T_end − (1 − A))² of T_end and A (R,); 0 without A."""
    if alpha is None:
        return transmittance.new_zeros(())
    return (transmittance - (1 - alpha)).square().mean()


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
    """The four terms of R rays, and Σ weight · term.

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
        total, terms, means = kernels.photometric_sum(alpha, weights, *floats, first, truth)
        return PhotometricSum(total, terms, means[0], None if alpha is None else means[1])
    place = torch.arange(len(sample_weight), device=first.device)
    ray = torch.searchsorted(first[1:].contiguous(), place, right=True).clamp(max=len(image) - 1)
    present = torch.where(place < first[-1], sample_weight, 0.0)
    terms = torch.stack(
        [
            color_error(image, truth),
            per_sample_color(present, sample_color, ray, truth),
            background_entropy(transmittance),
            alpha_mask_error(transmittance, alpha),
        ]
    )
    total = sum(weight * term for weight, term in zip(weights, terms.unbind(), strict=True))
    assert isinstance(total, Tensor)
    covered = None if alpha is None else alpha.mean()
    return PhotometricSum(total, terms.detach(), 1 - transmittance.detach().mean(), covered)

"""The photometric terms of a batch of rays. See docs/method.md#photometric-losses."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.ops.compositing import firsts, running_sum, sums_before

# A transmittance is at least so far from 0 and 1 in the entropy.
NEAREST = 1e-6
# The terms that DeVRF's stages weigh; a kernel has them together.
TERMS = ("render", "per_sample_color", "entropy", "alpha_mask")


def color_error(image: Tensor, truth: Tensor) -> Tensor:
    """Mean |Ĉ − C|² over rays and channels, of Ĉ and C (R, 3)."""
    return torch.nn.functional.mse_loss(image, truth)


def per_sample_color(weight: Tensor, color: Tensor, ray: Tensor, truth: Tensor) -> Tensor:
    """(1/R) Σ_i sg(w_i) |c_i − C|²: each sample by itself should have the pixel's colour.

    Args:
        weight: (K,) w of the samples; it gets no gradient.
        color: (K, 3) c of the samples.
        ray: (K,) int64, their rays.
        truth: (R, 3) C.
    """
    error = (color - truth.index_select(0, ray)).square().sum(dim=1)
    return (weight.detach() * error).sum() / len(truth)


def background_entropy(transmittance: Tensor) -> Tensor:
    """Mean −(p log p + (1 − p) log(1 − p)), p = T_end (R,): a ray hits something or nothing."""
    p = transmittance.clamp(NEAREST, 1 - NEAREST)
    return -(torch.xlogy(p, p) + torch.xlogy(1 - p, 1 - p)).mean()


def distortion(
    weight: Tensor, distance: Tensor, ray: Tensor, rays: int, length: Tensor | None = None
) -> Tensor:
    """(1/R) (Σ_i Σ_j w_i w_j |s_i − s_j| + ⅓ Σ_i w_i² δ_i) over the samples of each ray.

    mip-NeRF 360's distortion loss (equation 15).

    Args:
        weight: (K,) w of the samples.
        distance: (K,) s of the samples, ascending along each ray.
        ray: (K,) int64, ascending.
        rays: R.
        length: (K,) δ of the samples, in the unit of s; None leaves out their own term.
    """
    edges = firsts(ray, rays)
    mass, reached = (
        sums_before(running_sum(values), edges, ray).to(weight.dtype)
        for values in (weight, weight * distance)
    )
    total: Tensor = 2 * (weight * (distance * mass - reached)).sum()
    if length is not None:
        total = total + (weight.square() * length).sum() / 3
    return total / rays


def alpha_mask_error(transmittance: Tensor, alpha: Tensor | None) -> Tensor:
    """Mean (T_end − (1 − A))² of T_end and A (R,); 0 without A."""
    if alpha is None:
        return transmittance.new_zeros(())
    return (transmittance - (1 - alpha)).square().mean()

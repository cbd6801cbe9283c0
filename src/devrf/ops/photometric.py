"""The photometric terms of a batch of rays. See docs/method.md#photometric-losses."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.ops.compositing import firsts, running_sum, sums_before

# A transmittance is at least so far from 0 and 1 in the entropy.
NEAREST = 1e-6
# The terms that DeVRF's stages weigh; a kernel has them together.
TERMS = ("render", "per_sample_color", "entropy", "alpha_mask")


def pixel_means(values: Tensor, per_pixel: int) -> Tensor:
    """The means (P, …) over the rays of each pixel, of values (P · ``per_pixel``, …) of rays."""
    if per_pixel == 1:
        return values
    return values.reshape(-1, per_pixel, *values.shape[1:]).mean(dim=1)


def color_error(image: Tensor, truth: Tensor, per_pixel: int = 1) -> Tensor:
    """Mean |Ĉ − C|² over pixels and channels, of Ĉ and C (R, 3); Ĉ is a mean over a pixel's rays.

    Args:
        image: (R, 3) the colour of each ray.
        truth: (R, 3) C, the same for all rays of a pixel.
        per_pixel: the rays of a pixel, which follow one another.
    """
    return torch.nn.functional.mse_loss(
        pixel_means(image, per_pixel), pixel_means(truth, per_pixel)
    )


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


def alpha_mask_error(transmittance: Tensor, alpha: Tensor | None, per_pixel: int = 1) -> Tensor:
    """Mean (T_end − (1 − A))² over pixels, of T_end and A (R,); 0 without A.

    T_end is a mean over a pixel's rays, as in :func:`color_error`.
    """
    if alpha is None:
        return transmittance.new_zeros(())
    return pixel_means(transmittance - (1 - alpha), per_pixel).square().mean()

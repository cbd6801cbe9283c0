"""Volume rendering along rays whose samples lie one after another in memory.

Formulas use optical depths τ = σ·δ: opacity is α = 1 − exp(−τ), transmittance
T_i = Π_{j<i} (1 − α_j) = exp(−Σ_{j<i} τ_j), without logarithms of numbers near zero.
"""

from __future__ import annotations

import torch
from torch import Tensor

# A ray's Σ w is at least this in divisions.
LEAST_MASS = 1e-6


def composite(depth: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """Weights of samples, and each ray's transmittance behind them (Max 1995).

    ``w_i = T_i α_i`` and ``T_end = exp(−Σ_i τ_i)``; for example τ = (ln 2, ln 2) on one ray
    gives w = (1/2, 1/4) and T_end = 1/4.

    Args:
        depth: (S,) optical depths τ ≥ 0 of the samples, front to back within each ray.
        ray: (S,) int64, ascending: the ray of each sample.
        rays: R; a ray may have no sample.

    Returns:
        weights (S,) and end transmittance (R,), differentiable in ``depth``.
    """
    edges = firsts(ray, rays)
    passed = running_sum(depth)
    before = torch.exp(-sums_before(passed, edges, ray)).to(depth.dtype)
    end = torch.exp(passed[edges[:-1]] - passed[edges[1:]]).to(depth.dtype)
    return before * -torch.expm1(-depth), end


def composite_colors(
    weight: Tensor, color: Tensor, ray: Tensor, transmittance: Tensor, background: Tensor
) -> Tensor:
    """Ĉ = Σ w_i c_i + T_end · C_background (R, 3).

    Args:
        weight: (S,) w of the samples.
        color: (S, 3) c of the samples.
        ray: (S,) int64, their rays.
        transmittance: (R,) T_end.
        background: (3,) or (R, 3).
    """
    image = sum_by_ray(weight[:, None] * color, ray, len(transmittance))
    return image + transmittance[:, None] * background


def transmittances(depth: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Transmittance T_i (S,) before each sample; arguments as for :func:`composite`."""
    passed = sums_before(running_sum(depth), firsts(ray, rays), ray)
    return torch.exp(-passed).to(depth.dtype)


def sum_by_ray(values: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Sums (R, C) or (R,) of per-sample ``values`` (S, C) or (S,) over each ray.

    ``ray`` need not ascend.
    """
    return values.new_zeros((rays, *values.shape[1:])).index_add(0, ray, values)


@torch.no_grad()
def mean_distance(weight: Tensor, distance: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Depths Σ w_i z_i / Σ w_i (R,) of rays, 0 where all weights are.

    Args:
        weight: (S,) w of the samples.
        distance: (S,) z of the samples, along their rays.
        ray: (S,) int64, their rays.
        rays: R.
    """
    mass = sum_by_ray(weight, ray, rays)
    return sum_by_ray(weight * distance, ray, rays) / mass.clamp(min=LEAST_MASS)


def firsts(ray: Tensor, rays: int) -> Tensor:
    """The first sample of every ray, and the number of samples (R + 1,)."""
    return torch.searchsorted(ray, torch.arange(rays + 1, device=ray.device))


def running_sum(values: Tensor) -> Tensor:
    """Sums (S + 1,) of all values before each position, over all rays.

    They are in double precision: a ray's own sum is the difference of two large ones.
    """
    values = values.double()
    if values.is_cuda and torch.are_deterministic_algorithms_enabled():
        sums = sum_by_doubling(values)
    else:
        sums = values.cumsum(dim=0)
    return torch.nn.functional.pad(sums, (1, 0))


def sums_before(running: Tensor, edges: Tensor, ray: Tensor) -> Tensor:
    """Sums (S,) of the values before each sample on its own ray.

    Args:
        running: (S + 1,) of :func:`running_sum`.
        edges: (R + 1,) of :func:`firsts`.
        ray: (S,) int64, ascending: the ray of each sample.
    """
    # The gradient of index_select takes half the time of that of indexing.
    return running[:-1] - running.index_select(0, edges.index_select(0, ray))


def sum_by_doubling(values: Tensor) -> Tensor:
    """Running sums (S,) in ⌈log₂ S⌉ passes, with additions in a fixed order.

    ``cumsum`` on a GPU adds in the order in which its blocks finish.
    """
    reach = 1
    while reach < len(values):
        values = torch.cat([values[:reach], values[reach:] + values[:-reach]])
        reach *= 2
    return values

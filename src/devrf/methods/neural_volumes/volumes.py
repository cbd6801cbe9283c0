"""Decoded volumes, opacity that adds up along rays, and the priors of both."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from devrf.ops.compositing import firsts, running_sum, sum_by_ray, sums_before


@dataclass(frozen=True)
class Volumes:
    """Volumes of M moments over the cube [−1, 1]³.

    Attributes:
        template: (M, 4, T, T, T), axes z, y, x: RGB in [0, 1], and opacity per unit length.
        warp: (M, 3, W, W, W), axes z, y, x: the template's point for each of the cube.
    """

    template: Tensor
    warp: Tensor

    def at(self, points: Tensor, moment: Tensor) -> Tensor:
        """RGB and opacity per unit length (S, 4) at ``points``; nothing beyond the template.

        Args:
            points: (S, 3) in the cube.
            moment: (S,) int64, the moment of each.
        """
        order = moment.argsort(stable=True)
        counts = torch.bincount(moment, minlength=len(self.template)).tolist()
        parts = torch.split(points.index_select(0, order), counts)
        sampled = [
            _sampled(self.template[k], _sampled(self.warp[k], part))
            for k, part in enumerate(parts)
            if len(part)
        ]
        values = torch.cat(sampled) if sampled else points.new_zeros(0, 4)
        return torch.zeros_like(values).index_copy(0, order, values)


def _sampled(volume: Tensor, points: Tensor) -> Tensor:
    """Trilinear values (S, C) of a volume (C, Z, Y, X) at ``points`` (S, 3); 0 outside."""
    values = grid_sample(volume[None], points[None, None, None], align_corners=True)
    return values.view(len(volume), -1).t()


def added_opacity(amount: Tensor, ray: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """Each sample's weight, and each ray's opacity.

    A_i = min(1, A_{i−1} + a_i) and w_i = A_i − A_{i−1}: for example a = (0.75, 0.5, 1) on one ray
    gives w = (0.75, 0.25, 0) and A = 1 (docs/methods/neural_volumes.md#rendering).

    Args:
        amount: (S,) a_i = α_i δ_i ≥ 0, front to back within each ray.
        ray: (S,) int64, ascending.
        rays: R.

    Returns:
        w (S,) and A (R,).
    """
    before = sums_before(running_sum(amount), firsts(ray, rays), ray)
    weight = (before + amount).clamp(max=1) - before.clamp(max=1)
    return weight.to(amount.dtype), sum_by_ray(amount, ray, rays).clamp(max=1)


# log(0.1) + log(1.1): the opacity prior is 0 where all or nothing is seen.
OFFSET = -(math.log(0.1) + math.log(1.1))
FLOOR = 1e-5


def code_divergence(mean: Tensor, log_deviation: Tensor) -> Tensor:
    """KL of N(μ, s²) from N(0, 1), () the mean over codes' numbers: −½ − log s + ½μ² + ½s²."""
    square = (2 * log_deviation).exp()
    return (-0.5 - log_deviation + 0.5 * mean.square() + 0.5 * square).mean()


def opacity_prior(opacity: Tensor) -> Tensor:
    """() mean of log(0.1 + A) + log(1.1 − A) + 2.207 over rays' A (R,): all or nothing is best."""
    return ((0.1 + opacity).log() + (1.1 - opacity).log() + OFFSET).mean()


def log_total_variation(opacity: Tensor) -> Tensor:
    """() mean of √(1e-5 + Σ_axes (difference of log(1e-5 + α))²) over voxels.

    Args:
        opacity: (M, X, Y, Z) α of M templates.
    """
    logs = (FLOOR + opacity).log()
    inner = logs[:, :-1, :-1, :-1]
    steps = (
        logs[:, 1:, :-1, :-1] - inner,
        logs[:, :-1, 1:, :-1] - inner,
        logs[:, :-1, :-1, 1:] - inner,
    )
    return (FLOOR + torch.stack([step.square() for step in steps]).sum(dim=0)).sqrt().mean()

"""The terms beside the colours: of the code, of what rays see, of the template."""

from __future__ import annotations

import math

import torch
from torch import Tensor

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

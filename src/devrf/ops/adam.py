"""One step of Adam on a tensor, and the gradient of a grid's total variation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class AdamRule:
    """Settings of a step of Adam (Kingma & Ba 2015), with additions for voxel grids.

    Attributes:
        rate: learning rate.
        step: number of this step, 1 for the first.
        betas: decay of the mean and of the square.
        eps: added to the root of the square.
        skip_zero: an entry whose gradient is exactly zero keeps its value *and its moments*.
        per_voxel_lr: None, or factors (X, Y, Z, 1) of the learning rate.
    """

    rate: float
    step: int
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-8
    skip_zero: bool = False
    per_voxel_lr: Tensor | None = None

    @property
    def corrections(self) -> tuple[float, float]:
        """1 − β₁ᵗ and 1 − β₂ᵗ."""
        beta1, beta2 = self.betas
        return 1 - beta1**self.step, 1 - beta2**self.step


def adam_step(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rule: AdamRule
) -> None:
    """Step in place.

    ``m ← β₁m + (1 − β₁)g``, ``s ← β₂s + (1 − β₂)g²``,
    ``v ← v − rate·per_voxel_lr · (m / (1 − β₁ᵗ)) / (√(s / (1 − β₂ᵗ)) + ε)``.

    Args:
        values: of any shape; (X, Y, Z, C) with ``per_voxel_lr``.
        gradient: the same shape; zero afterwards.
        mean: first moments m, the same shape, changed in place.
        square: second moments s, likewise.
        rule: the settings.
    """
    beta1, beta2 = rule.betas
    first, second = rule.corrections
    stepped = gradient != 0 if rule.skip_zero else torch.ones_like(gradient, dtype=torch.bool)
    mean.copy_(torch.where(stepped, beta1 * mean + (1 - beta1) * gradient, mean))
    square.copy_(torch.where(stepped, beta2 * square + (1 - beta2) * gradient**2, square))
    move = rule.rate * (mean / first) / ((square / second).sqrt() + rule.eps)
    if rule.per_voxel_lr is not None:
        move = move * rule.per_voxel_lr
    values.sub_(torch.where(stepped, move, 0.0))
    gradient.zero_()


def add_total_variation_gradient(
    grid: Tensor,
    gradient: Tensor,
    weight: float,
    *,
    along_z: float = 1.0,
    bound: float = 1.0,
    touched_only: bool = False,
) -> None:
    """Add ``weight`` times the gradient of a grid's total variation to ``gradient`` in place.

    The total variation is Σ over pairs of neighbours of h(v − v'), with the Huber penalty
    h(d) = d²/2 for |d| ≤ b and b |d| − b²/2 beyond. Its derivative at a voxel is
    Σ_neighbours clamp(v − v', −b, b).

    Args:
        grid: (X, Y, Z, C).
        gradient: the same shape.
        weight: factor of the penalty.
        along_z: further factor between neighbours along z.
        bound: b.
        touched_only: add only to entries that are not zero.
    """
    slopes = torch.zeros_like(grid)
    for axis in range(3):
        factor = weight * along_z if axis == 2 else weight
        slope = factor * grid.diff(dim=axis).clamp(-bound, bound)
        length = grid.shape[axis] - 1
        slopes.narrow(axis, 1, length).add_(slope)
        slopes.narrow(axis, 0, length).sub_(slope)
    gradient.add_(torch.where(gradient != 0, slopes, 0.0) if touched_only else slopes)

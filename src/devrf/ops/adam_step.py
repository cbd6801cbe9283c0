"""One step of Adam on a tensor, and the gradient of a grid's total variation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class AdamRule:
    """Settings of a step of Adam (Kingma & Ba 2015), with additions for voxel grids.

    Attributes:
        rate: learning rate.
        step: () number of this step, 1 for the first.
        betas: decay of the mean and of the square.
        eps: added to the root of the square.
        skip_zero: an entry whose gradient is exactly zero keeps its value *and its moments*.
        per_voxel_lr: None, or factors (X, Y, Z, 1) of the learning rate.
        rows: None, or with ``skip_zero`` the voxels (K,), int32 and ascending, outside which no
            gradient is read: it must be zero there.
    """

    rate: float
    step: Tensor
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-8
    skip_zero: bool = False
    per_voxel_lr: Tensor | None = None
    rows: Tensor | None = None


def adam_step(
    values: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rule: AdamRule,
    *,
    clear: bool = True,
) -> None:
    """Step in place.

    ``m ← β₁m + (1 − β₁)g``, ``s ← β₂s + (1 − β₂)g²``,
    ``v ← v − rate·per_voxel_lr · (m / (1 − β₁ᵗ)) / (√(s / (1 − β₂ᵗ)) + ε)``.

    Args:
        values: of any shape, contiguous; (X, Y, Z, C) with ``per_voxel_lr``.
        gradient: the same shape.
        mean: first moments, the same shape, changed in place.
        square: second moments, likewise.
        rule: the settings.
        clear: whether to set the gradient to zero afterwards.
    """
    if rule.skip_zero:
        _step_touched(values, gradient, mean, square, rule, clear)
        return
    _step(values, gradient, mean, square, rule)
    if clear:
        gradient.zero_()


def add_total_variation_gradient(
    grid: Tensor,
    gradient: Tensor,
    weight: float,
    *,
    along_z: float = 1.0,
    touched_only: bool = False,
) -> None:
    """Add ``weight`` times the gradient of a grid's total variation to ``gradient`` in place.

    The total variation is Σ over pairs of neighbours of h(v − v'), with the Huber penalty
    h(d) = d²/2 for |d| ≤ 1 and |d| − 1/2 beyond. Its derivative at a voxel is
    Σ_neighbours clamp(v − v', −1, 1); in closed form, because an autograd graph over every voxel
    at every step would be slow.

    Args:
        grid: (X, Y, Z, C).
        gradient: the same shape.
        weight: factor of the penalty.
        along_z: further factor between neighbours along z.
        touched_only: add only to entries that are not zero.
    """
    into = torch.zeros_like(gradient) if touched_only else gradient
    for axis in range(3):
        after, before = _neighbours(grid, axis)
        slope = (after - before).clamp_(-1, 1)
        into_after, into_before = _neighbours(into, axis)
        factor = weight * along_z if axis == 2 else weight
        into_after.add_(slope, alpha=factor)
        into_before.sub_(slope, alpha=factor)
    if touched_only:
        gradient += into * (gradient != 0)


def _neighbours(grid: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    length = grid.shape[axis] - 1
    return grid.narrow(axis, 1, length), grid.narrow(axis, 0, length)


def _step(values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, rule: AdamRule) -> None:
    beta1, beta2 = rule.betas
    mean.lerp_(grad, 1 - beta1)
    square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
    size, correction = _step_size(rule)
    move = mean / (square / correction).sqrt_().add_(rule.eps)
    if rule.per_voxel_lr is not None:
        move *= rule.per_voxel_lr
    values.addcmul_(move, size.to(values.dtype), value=-1)


def _step_touched(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, rule: AdamRule, clear: bool
) -> None:
    """As :func:`_step`, only on rows with a gradient, then cleared: most of a grid has none."""
    beta1, beta2 = rule.betas
    channels = values.shape[-1]
    gradients = grad.view(-1, channels)
    looked_at = gradients if rule.rows is None else gradients.index_select(0, rule.rows)
    rows = _touched_rows(looked_at)
    g = looked_at.index_select(0, rows)
    rows = rows if rule.rows is None else rule.rows.index_select(0, rows).long()
    touched = g != 0
    means, squares = mean.view(-1, channels), square.view(-1, channels)
    m, s = means.index_select(0, rows), squares.index_select(0, rows)
    m = torch.where(touched, m + (1 - beta1) * (g - m), m)
    s = torch.where(touched, s + (1 - beta2) * (g * g - s), s)
    means.index_copy_(0, rows, m)
    squares.index_copy_(0, rows, s)
    size, correction = _step_size(rule)
    move = m / (s / correction).sqrt_().add_(rule.eps)
    if rule.per_voxel_lr is not None:
        move *= rule.per_voxel_lr.view(-1, 1)[rows]
    table = values.view(-1, channels)
    before = table.index_select(0, rows)
    after = before - size * torch.where(touched, move, torch.zeros_like(move))
    table.index_copy_(0, rows, after)
    if clear:
        gradients.index_fill_(0, rows, 0.0)


def _touched_rows(table: Tensor) -> Tensor:
    """The rows (K,) of a table (N, C) that are not zero; rows of −0 may be among them.

    The bits of a row are read as words, if possible of two floats: that takes a third of the time
    of comparing each number with zero.
    """
    size = table.element_size()
    pairs = table.shape[1] * size % 8 == 0 == table.storage_offset() * size % 8
    return table.view(torch.int64 if pairs else torch.int32).any(dim=1).nonzero()[:, 0]


def _step_size(rule: AdamRule) -> tuple[Tensor, Tensor]:
    """Learning rate with the mean's bias correction, and the square's bias correction."""
    first, second = (-torch.expm1(rule.step * math.log(beta)) for beta in rule.betas)
    return rule.rate / first, second

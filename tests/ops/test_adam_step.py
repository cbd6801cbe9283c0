"""One step of Adam: what it leaves behind, and the total variation within it, by hand."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devrf.ops.adam_step import AdamRule, adam_step, add_total_variation_gradient


def rule(step: int = 1, **options: Any) -> AdamRule:
    return AdamRule(0.1, torch.tensor(float(step)), **options)


def peak() -> Tensor:
    """Zero everywhere but at one voxel, which exceeds its neighbours by 5."""
    grid = torch.zeros(2, 2, 2, 1)
    grid[1, 1, 1] = 5.0
    return grid


def test_a_step_clears_the_gradient_unless_told_otherwise() -> None:
    for clear in (True, False):
        values, gradient = torch.zeros(3), torch.tensor([1.0, -2.0, 0.0])
        adam_step(values, gradient, torch.zeros(3), torch.zeros(3), rule(), clear=clear)
        torch.testing.assert_close(values, torch.tensor([-0.1, 0.1, 0.0]))
        assert gradient.any() != clear


def total_variation(grid: Tensor) -> Tensor:
    """The Huber penalty of the differences along each axis."""
    pairs = [
        (grid.narrow(k, 1, grid.shape[k] - 1), grid.narrow(k, 0, grid.shape[k] - 1))
        for k in range(3)
    ]
    return sum(torch.nn.functional.huber_loss(*pair, reduction="sum") for pair in pairs)


def test_the_gradient_of_the_total_variation(rng: torch.Generator) -> None:
    grid = torch.randn(4, 3, 5, 2, generator=rng, dtype=torch.float64).mul_(1.5).requires_grad_()
    (truth,) = torch.autograd.grad(total_variation(grid), grid)
    ours = torch.zeros_like(grid)
    add_total_variation_gradient(grid.detach(), ours, 1.0)
    torch.testing.assert_close(ours, truth)
    values = peak()
    touched = torch.zeros(2, 2, 2, 1)
    touched[1, 1, 1] = 1.0
    add_total_variation_gradient(values, touched, 0.5, along_z=3.0, touched_only=True)
    # 1 of each of three neighbours, of the one along z three times.
    assert touched[1, 1, 1].item() == 3.5 and touched.count_nonzero() == 1

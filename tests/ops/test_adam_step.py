"""One step of Adam: what it leaves behind, and the total variation within it, by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.ops.adam_step import (
    AdamRule,
    adam_step,
    add_total_variation_gradient,
    smooth_adam_step,
)


def rule(step: int = 1, **options: Any) -> AdamRule:
    return AdamRule(torch.tensor(0.1), torch.tensor(float(step)), **options)


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


def test_smoothing_pulls_at_a_peak_and_its_neighbours_by_their_old_values() -> None:
    values, into, gradient = peak(), torch.empty(2, 2, 2, 1), torch.zeros(2, 2, 2, 1)
    mean, square = torch.zeros_like(values), torch.zeros_like(values)
    smooth_adam_step(values, into, gradient, mean, square, rule(), smoothing=0.5)
    assert torch.equal(values, peak())
    # At the peak 0.5·3, at each of its three neighbours −0.5; a tenth of it is the mean.
    assert mean[1, 1, 1].item() == pytest.approx(0.15)
    assert mean[0, 1, 1].item() == mean[1, 0, 1].item() == pytest.approx(-0.05)
    assert mean[0, 0, 0].item() == 0
    assert into[1, 1, 1].item() == pytest.approx(4.9)
    assert into[0, 1, 1].item() == pytest.approx(0.1)


def test_smoothing_of_what_is_touched_leaves_the_rest() -> None:
    values, into, gradient = peak(), torch.empty(2, 2, 2, 1), torch.zeros(2, 2, 2, 1)
    gradient[1, 1, 1] = 1.0
    mean, square = torch.zeros_like(values), torch.zeros_like(values)
    tensors = (values, into, gradient, mean, square)
    smooth_adam_step(*tensors, rule(skip_zero=True), smoothing=0.5)
    assert mean[1, 1, 1].item() == pytest.approx(0.25)
    assert mean.count_nonzero() == 1 and not gradient.any()
    expected = peak()
    expected[1, 1, 1] = 4.9
    torch.testing.assert_close(into, expected)


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
    add_total_variation_gradient(values, touched, 0.5, touched_only=True)
    assert touched[1, 1, 1].item() == 2.5 and touched.count_nonzero() == 1

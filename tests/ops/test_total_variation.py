"""The Huber total variation by hand, and its closed-form gradient."""

from __future__ import annotations

import pytest
import torch

from devrf.ops.total_variation import add_total_variation_gradient, total_variation


def test_one_step_along_each_axis_by_hand() -> None:
    grid = torch.zeros(2, 2, 2, 1)
    grid[0, 0, 0] = 0.5
    # Three neighbours, each 0.5² / 2.
    assert total_variation(grid).item() == pytest.approx(0.375)
    grid[0, 0, 0] = 3.0
    # Beyond 1 the penalty is linear: 3 − 1/2 for each neighbour.
    assert total_variation(grid).item() == pytest.approx(7.5)


def test_gradient_is_that_of_the_value(rng: torch.Generator) -> None:
    grid = torch.randn(4, 3, 5, 2, generator=rng, dtype=torch.float64).mul_(1.5).requires_grad_()
    (truth,) = torch.autograd.grad(total_variation(grid), grid)
    ours = torch.zeros_like(grid)
    add_total_variation_gradient(grid.detach(), ours, 1.0)
    torch.testing.assert_close(ours, truth)


def test_gradient_is_added_with_its_weight_to_what_is_there() -> None:
    grid, gradient = torch.zeros(2, 2, 2, 1), torch.full((2, 2, 2, 1), 10.0)
    grid[1, 1, 1] = 5.0
    add_total_variation_gradient(grid, gradient, 0.5)
    # At the peak Σ clamp(5, −1, 1) = 3, at each neighbour −1.
    assert gradient[1, 1, 1].item() == pytest.approx(11.5)
    assert gradient[0, 1, 1].item() == pytest.approx(9.5)
    assert gradient[0, 0, 0].item() == pytest.approx(10.0)


def test_only_what_is_touched_is_smoothed(rng: torch.Generator) -> None:
    grid = torch.randn(3, 4, 2, 2, generator=rng)
    gradient = torch.randn(3, 4, 2, 2, generator=rng).clamp(min=0)
    everywhere, touched = gradient.clone(), gradient.clone()
    add_total_variation_gradient(grid, everywhere, 0.3)
    add_total_variation_gradient(grid, touched, 0.3, touched_only=True)
    torch.testing.assert_close(touched, torch.where(gradient != 0, everywhere, 0.0))
    assert (touched == 0).any() and (touched != 0).any()

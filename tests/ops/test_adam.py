"""One step of Adam, and the gradient of the total variation: by hand, and by autograd."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from devrf.ops.adam import AdamRule, adam_step, add_total_variation_gradient


def peak() -> Tensor:
    """Zero everywhere but at one voxel, which exceeds its neighbours by 5."""
    grid = torch.zeros(2, 2, 2, 1)
    grid[1, 1, 1] = 5.0
    return grid


def test_a_step_clears_the_gradient() -> None:
    values, gradient = torch.zeros(3), torch.tensor([1.0, -2.0, 0.0])
    adam_step(values, gradient, torch.zeros(3), torch.zeros(3), AdamRule(0.1, 1))
    torch.testing.assert_close(values, torch.tensor([-0.1, 0.1, 0.0]))
    assert not gradient.any()


@pytest.mark.parametrize("skip_zero", [False, True])
def test_a_second_step_by_hand(skip_zero: bool) -> None:
    values, gradient = torch.tensor([1.0, 1.0]), torch.tensor([3.0, 0.0])
    mean, square = torch.tensor([0.2, 0.2]), torch.tensor([0.04, 0.04])
    adam_step(values, gradient, mean, square, AdamRule(0.1, 2, skip_zero=skip_zero))
    # m = 0.9·0.2 + 0.1·3, s = 0.99·0.04 + 0.01·9; with no gradient 0.9·0.2 and 0.99·0.04.
    still = (0.2, 0.04) if skip_zero else (0.18, 0.0396)
    assert mean.tolist() == pytest.approx([0.48, still[0]])
    assert square.tolist() == pytest.approx([0.1296, still[1]])
    moves = [
        0.1 * (m / (1 - 0.9**2)) / (math.sqrt(s / (1 - 0.99**2)) + 1e-8)
        for m, s in ((0.48, 0.1296), (0.18, 0.0396))
    ]
    assert values.tolist() == pytest.approx([1 - moves[0], 1.0 if skip_zero else 1 - moves[1]])


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

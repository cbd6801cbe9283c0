"""The kernels of Adam and of the total variation against their PyTorch twins."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from devrf.ops.adam import GridAdam
from devrf.ops.adam_step import AdamRule, adam_step, smooth_adam_step
from devrf.ops.total_variation import add_total_variation_gradient

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], tuple[Tensor, ...]]], None]


def rule(device: torch.device, step: int, **options: object) -> AdamRule:
    rate = torch.tensor(0.1, dtype=torch.float64, device=device)
    number = torch.tensor(float(step), device=device)
    return AdamRule(rate, number, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("paced", [False, True])
@pytest.mark.parametrize("skip_zero", [False, True])
@pytest.mark.parametrize("smooth", [None, "everywhere", "touched"])
@pytest.mark.parametrize("shape", [(3, 2, 4, 1), (2, 3, 50, 3)])
def test_steps(
    draw: Draw,
    agree: Both,
    device: torch.device,
    shape: tuple[int, ...],
    smooth: str | None,
    skip_zero: bool,
    paced: bool,
) -> None:
    start, factors = 2 * draw(*shape), draw(*shape[:3], 1).abs() if paced else None
    # About half of the entries without a gradient, others in each step.
    gradients = [draw(*shape).clamp(min=0) for _ in range(2)]

    def work() -> tuple[Tensor, ...]:
        values, other = start.clone(), torch.empty_like(start)
        mean, square = torch.zeros_like(start), torch.zeros_like(start)
        for number, gradient in enumerate(gradients, start=1):
            grad = gradient.clone()
            how = rule(device, number, skip_zero=skip_zero, per_voxel_lr=factors)
            if smooth is None:
                adam_step(values, grad, mean, square, how)
            else:
                tensors, touched = (values, other, grad, mean, square), smooth == "touched"
                smooth_adam_step(*tensors, how, smoothing=0.3, touched_only=touched)
                values, other = other, values
            assert not grad.any()
        return values, mean, square

    agree(work)


@pytest.mark.parametrize("count", [0, 300])
def test_the_gradient_may_be_kept(
    draw: Draw, agree: Both, device: torch.device, count: int
) -> None:
    gradient = draw(count)

    def work() -> tuple[Tensor, ...]:
        values, mean, square = torch.zeros(3, count, device=device)
        grad = gradient.clone()
        adam_step(values, grad, mean, square, rule(device, 1), clear=False)
        return values, grad

    agree(work)


@pytest.mark.parametrize("shape", [(4, 3, 5, 3), (2, 2, 2, 1), (2, 2, 400, 3)])
def test_gradient_of_the_total_variation(draw: Draw, agree: Both, shape: tuple[int, ...]) -> None:
    grid, gradient = 2 * draw(*shape), draw(*shape).clamp(min=0)

    def work() -> tuple[Tensor, ...]:
        into, touched = gradient.clone(), gradient.clone()
        add_total_variation_gradient(grid, into, 0.3)
        add_total_variation_gradient(grid, touched, 0.3, touched_only=True)
        return into, touched

    agree(work)


def test_the_optimizer_steps_alike(draw: Draw, agree: Both) -> None:
    grid, matrix = draw(3, 3, 4, 2), draw(5, 7)
    gradients = [(draw(3, 3, 4, 2).clamp(min=0), draw(7, 5).t()) for _ in range(3)]

    def work() -> tuple[Tensor, ...]:
        leaves = [grid.clone().requires_grad_(), matrix.clone().requires_grad_()]
        optimizer = GridAdam(
            [{"params": leaves[:1], "lr": 0.1, "skip_zero": True}, {"params": leaves[1:]}]
        )
        for pair in gradients:
            for leaf, gradient in zip(leaves, pair, strict=True):
                leaf.grad = gradient
            optimizer.step()
        return tuple(leaf.detach() for leaf in leaves)

    agree(work)

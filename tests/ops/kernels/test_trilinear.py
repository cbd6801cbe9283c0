"""The interpolation kernels against their PyTorch twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from devrf.ops.dispatch import using
from devrf.ops.trilinear import interpolate

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], tuple[Tensor, ...]]], None]


def everything(grid: Tensor, coords: Tensor, upstream: Tensor) -> tuple[Tensor, ...]:
    """Values and both gradients."""
    grid, coords = grid.clone().requires_grad_(), coords.clone().requires_grad_()
    values = interpolate(grid, coords)
    return values.detach(), *torch.autograd.grad(values, (grid, coords), upstream)


@pytest.mark.parametrize(
    ("channels", "points"),
    # None, one, and some more than a block or two hold.
    [(1, 0), (1, 1), (1, 131), (3, 0), (3, 35), (9, 19), (12, 0), (12, 1), (12, 67)],
)
def test_values_and_gradients(draw: Draw, agree: Both, channels: int, points: int) -> None:
    # About half of the points lie outside the grid.
    grid, coords = draw(4, 5, 3, channels), 2 + 3.5 * draw(points, 3)
    upstream = draw(points, channels)
    agree(lambda: everything(grid, coords, upstream))


def test_grid_points_and_borders(draw: Draw, agree: Both, device: torch.device) -> None:
    axes = [torch.tensor([-0.5, 0.0, 1.0, n - 1.0, n + 3.0]) for n in (4, 5, 3)]
    coords = torch.cartesian_prod(*axes).to(device)
    grid, upstream = draw(4, 5, 3, 3), draw(len(coords), 3)
    agree(lambda: everything(grid, coords, upstream))


def test_a_coordinate_that_is_no_number_stays_inside_memory(device: torch.device) -> None:
    grid = torch.arange(8.0).view(2, 2, 2, 1).to(device)
    with using("triton"):
        values = interpolate(grid, torch.full((1, 3), float("nan")).to(device))
    assert values.shape == (1, 1)


@pytest.mark.parametrize("frozen", [0, 1])
def test_only_the_gradient_that_is_asked_for(draw: Draw, agree: Both, frozen: int) -> None:
    inputs, upstream = (draw(3, 3, 3, 3), 1 + draw(20, 3)), draw(20, 3)

    def work() -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_(n != frozen) for n, x in enumerate(inputs)]
        interpolate(leaves[0], leaves[1]).backward(upstream)
        assert leaves[frozen].grad is None
        found = leaves[1 - frozen].grad
        assert found is not None
        return (found,)

    agree(work)


def test_the_gradient_may_be_added_to_a_buffer(draw: Draw, agree: Both) -> None:
    grid, buffer = draw(3, 4, 3, 12), draw(3, 4, 3, 12)
    coords, upstream = 1 + draw(40, 3), draw(40, 12)

    def work() -> tuple[Tensor, ...]:
        leaf, into = grid.clone().requires_grad_(), buffer.clone()
        interpolate(leaf, coords, gradient=into).backward(upstream)
        assert leaf.grad is None
        return (into,)

    agree(work)


def test_a_grid_in_another_order_of_memory(draw: Draw, agree: Both) -> None:
    grid, coords = draw(3, 5, 4, 3).permute(2, 1, 0, 3), 2 * draw(30, 3)
    upstream = draw(30, 3)
    agree(lambda: everything(grid, coords, upstream))

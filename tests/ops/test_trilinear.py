"""Trilinear interpolation against values computed by hand, and its gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from devrf.geometry.box import Box
from devrf.ops.trilinear import interpolate

UNIT = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def corner_grid() -> Tensor:
    """2×2×2 grid whose value at (i, j, k) is 1 + i + 10·j + 100·k + 1000·i·j·k."""
    i, j, k = torch.meshgrid(*[torch.arange(2.0)] * 3, indexing="ij")
    return (1 + i + 10 * j + 100 * k + 1000 * i * j * k)[..., None]


@pytest.mark.parametrize(
    ("at", "value"),
    [
        ((0.0, 0.0, 0.0), 1.0),
        ((1.0, 1.0, 1.0), 1112.0),
        ((0.0, 1.0, 1.0), 111.0),
        # All eight corners: 1 + 0.5 + 5 + 50 + 1000 / 8.
        ((0.5, 0.5, 0.5), 181.5),
        # 1 + 0.25 + 10·0.5 + 100·0.75 + 1000·0.25·0.5·0.75.
        ((0.25, 0.5, 0.75), 175.0),
    ],
)
def test_interpolates_between_eight_corners(at: tuple[float, float, float], value: float) -> None:
    found = interpolate(corner_grid(), torch.tensor([at]), UNIT).item()
    assert found == pytest.approx(value, rel=1e-6)


def test_is_exact_at_every_grid_point_of_a_grid_with_unequal_sides(rng: torch.Generator) -> None:
    grid = torch.randn(3, 4, 5, 2, generator=rng)
    points = torch.cartesian_prod(torch.arange(3.0), torch.arange(4.0), torch.arange(5.0))
    box = Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0))
    assert torch.equal(interpolate(grid, points, box), grid.reshape(-1, 2))


def test_the_grid_lies_on_the_box() -> None:
    box = Box((-1.1, 0.3, -0.7), (0.9, 2.2, 1.3))
    shape = (7, 160, 33)
    # A grid of its own coordinates.
    grid = torch.stack(torch.meshgrid(*map(torch.arange, shape), indexing="ij"), dim=-1).float()
    points = torch.tensor([box.low, box.middle, box.high])
    expected = torch.tensor([[0.0, 0.0, 0.0], [3.0, 79.5, 16.0], [6.0, 159.0, 32.0]])
    torch.testing.assert_close(interpolate(grid, points, box), expected)


def test_outside_the_border_goes_on(rng: torch.Generator) -> None:
    grid = torch.randn(3, 3, 3, 1, generator=rng)
    points = torch.tensor([[-5.0, 1.0, 1.0], [9.0, 1.0, 1.0], [1.0, -0.01, 7.0]])
    expected = torch.stack([grid[0, 1, 1], grid[2, 1, 1], grid[1, 0, 2]])
    torch.testing.assert_close(interpolate(grid, points, Box((0.0,) * 3, (2.0,) * 3)), expected)


def test_gradients_of_values_and_positions(rng: torch.Generator) -> None:
    grid = torch.randn(3, 4, 3, 2, generator=rng, dtype=torch.float64, requires_grad=True)
    # Off the grid planes, where the slope jumps; two points in one cell, one outside.
    points = torch.tensor(
        [[0.3, 1.2, 0.7], [1.6, 2.9, 1.1], [0.2, 1.4, 0.9], [1.4, -0.5, 2.6]],
        dtype=torch.float64,
        requires_grad=True,
    )
    box = Box((0.0, 0.0, 0.0), (2.0, 6.0, 1.0))
    points = (points.detach() * torch.tensor([1.0, 2.0, 0.5])).requires_grad_()
    assert gradcheck(lambda grid, points: interpolate(grid, points, box), (grid, points))


@pytest.mark.parametrize("channels", [1, 4])
def test_no_points_is_no_values_and_no_gradient(channels: int) -> None:
    grid = torch.ones(2, 3, 2, channels, requires_grad=True)
    points = torch.zeros(0, 3, requires_grad=True)
    out = interpolate(grid, points, UNIT)
    assert out.shape == (0, channels)
    out.sum().backward()
    assert grid.grad is not None and not grid.grad.any()
    assert points.grad is not None and points.grad.shape == (0, 3)

"""Trilinear interpolation against values computed by hand, and its gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from devrf.geometry.box import Box
from devrf.ops.corners import to_grid
from devrf.ops.trilinear import interpolate


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
    assert interpolate(corner_grid(), torch.tensor([at])).item() == pytest.approx(value, rel=1e-6)


def test_is_exact_at_every_grid_point_of_a_grid_with_unequal_sides(rng: torch.Generator) -> None:
    grid = torch.randn(3, 4, 5, 2, generator=rng)
    points = torch.cartesian_prod(torch.arange(3.0), torch.arange(4.0), torch.arange(5.0))
    assert torch.equal(interpolate(grid, points), grid.reshape(-1, 2))


def test_outside_the_border_goes_on(rng: torch.Generator) -> None:
    grid = torch.randn(3, 3, 3, 1, generator=rng)
    coords = torch.tensor([[-5.0, 1.0, 1.0], [9.0, 1.0, 1.0], [1.0, -0.01, 7.0]])
    expected = torch.stack([grid[0, 1, 1], grid[2, 1, 1], grid[1, 0, 2]])
    torch.testing.assert_close(interpolate(grid, coords), expected)


def test_gradients_of_values_and_positions(rng: torch.Generator) -> None:
    grid = torch.randn(3, 4, 3, 2, generator=rng, dtype=torch.float64, requires_grad=True)
    # Off the grid planes, where the slope jumps; two points in one cell, one outside.
    coords = torch.tensor(
        [[0.3, 1.2, 0.7], [1.6, 2.9, 1.1], [0.2, 1.4, 0.9], [1.4, -0.5, 2.6]],
        dtype=torch.float64,
        requires_grad=True,
    )
    assert gradcheck(interpolate, (grid, coords))


@pytest.mark.parametrize("channels", [1, 4])
def test_no_points_is_no_values_and_no_gradient(channels: int) -> None:
    grid = torch.ones(2, 3, 2, channels, requires_grad=True)
    coords = torch.zeros(0, 3, requires_grad=True)
    out = interpolate(grid, coords)
    assert out.shape == (0, channels)
    out.sum().backward()
    assert grid.grad is not None and not grid.grad.any()
    assert coords.grad is not None and coords.grad.shape == (0, 3)


def test_the_gradient_of_a_grid_may_be_added_to_a_buffer() -> None:
    grid, into = torch.zeros(2, 2, 2, 1, requires_grad=True), torch.ones(2, 2, 2, 1)
    interpolate(grid, torch.tensor([[0.25, 0.0, 0.0]]), gradient=into).sum().backward()
    assert grid.grad is None
    assert into[0, 0, 0].item() == pytest.approx(1.75)
    assert into[1, 0, 0].item() == pytest.approx(1.25)
    assert into[:, 1].eq(1).all()


def test_a_shape_first_met_in_inference_mode_can_be_trained() -> None:
    grid, box = torch.zeros(2, 3, 9, 1), Box((0.0, 0.0, 0.0), (1.0, 1.0, 8.0))
    with torch.inference_mode():
        interpolate(grid, to_grid(torch.ones(1, 3), box, (2, 3, 9)))
    points = torch.ones(1, 3, requires_grad=True)
    coords = to_grid(points, box, (2, 3, 9))
    (interpolate(grid, coords).sum() + coords.sum()).backward()
    assert points.grad is not None and points.grad.tolist() == [[1.0, 2.0, 1.0]]

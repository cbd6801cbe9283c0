"""Interpolation by kernels, and their gradients, against their definition in double precision."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.kernels.trilinear import add_to_grid, interpolate
from devrf.ops import trilinear

BOX = Box((-1.1, 0.3, -0.7), (0.9, 2.2, 1.3))
SHAPE = (7, 4, 5)
PLANE = (7, 4, 1)
CHANNELS = [1, 3, 9, 12]


def points_around(count: int, rng: torch.Generator) -> Tensor:
    """Points in the box and around it, none within rounding of a grid plane, where slopes jump."""
    low, high = BOX.corners(torch.zeros(()))
    points = low + (high - low) * (1.6 * torch.rand(2 * count, 3, generator=rng) - 0.3)
    at = BOX.to_grid(points.double(), SHAPE)
    clear = ((at - at.round()).abs() > 1e-4).all(dim=1)
    chosen = points[clear][:count]
    inside = BOX.contains(chosen)
    assert len(chosen) == count and (count < 10 or (inside.any() and not inside.all()))
    return chosen


@pytest.mark.parametrize("shape", [SHAPE, PLANE])
@pytest.mark.parametrize("channels", CHANNELS)
def test_values_and_gradients_are_those_of_the_definition(
    channels: int, shape: tuple[int, int, int], rng: torch.Generator
) -> None:
    grid = torch.randn(*shape, channels, generator=rng).requires_grad_()
    points = points_around(1000, rng).requires_grad_()
    factor = torch.randn(1000, channels, generator=rng)
    exact_grid = grid.detach().double().requires_grad_()
    exact_points = points.detach().double().requires_grad_()
    values = interpolate(grid, points, BOX)
    exact = trilinear.interpolate(exact_grid, exact_points, BOX)
    assert values.shape == (1000, channels)
    torch.testing.assert_close(values.double(), exact, atol=1e-5, rtol=0)
    (values * factor).sum().backward()
    (exact * factor).sum().backward()
    torch.testing.assert_close(grid.grad.double(), exact_grid.grad, atol=1e-4, rtol=0)
    torch.testing.assert_close(points.grad.double(), exact_points.grad, atol=1e-3, rtol=1e-4)
    outside = ~BOX.contains(points)
    assert outside.any() and points.grad[outside].eq(0).any(dim=1).all()


@pytest.mark.parametrize("look", [interpolate, trilinear.interpolate])
def test_every_second_point_is_a_grid_of_its_own(
    look: Callable[..., Tensor], rng: torch.Generator
) -> None:
    grid = torch.randn(7, 5, 9, 3, generator=rng).requires_grad_()
    points = points_around(500, rng).requires_grad_()
    factor = torch.randn(500, 3, generator=rng)
    alone = grid.detach()[::2, ::2, ::2].contiguous().requires_grad_()
    beside = points.detach().clone().requires_grad_()
    (look(grid, points, BOX, stride=2) * factor).sum().backward()
    (interpolate(alone, beside, BOX) * factor).sum().backward()
    torch.testing.assert_close(grid.grad[::2, ::2, ::2], alone.grad)
    torch.testing.assert_close(points.grad, beside.grad)
    # The points between have no part in it; what a grid has from elsewhere stays.
    between = torch.ones(7, 5, 9, dtype=torch.bool)
    between[::2, ::2, ::2] = False
    assert not grid.grad[between].any()
    look(grid, points, BOX).sum().backward()
    grid_alone = grid.detach().clone().requires_grad_()
    look(grid_alone, points.detach(), BOX).sum().backward()
    expected = grid_alone.grad.clone()
    expected[::2, ::2, ::2] += alone.grad
    torch.testing.assert_close(grid.grad, expected)


@pytest.mark.parametrize("look", [interpolate, trilinear.interpolate])
def test_a_plane_is_the_same_for_all_z(look: Callable[..., Tensor]) -> None:
    plane = torch.tensor([[0.0, 2.0], [4.0, 6.0]])[:, :, None, None].requires_grad_()
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    points = torch.tensor([[0.25, 0.5, 0.1], [0.25, 0.5, 0.9], [2.0, 0.5, 7.0]])
    values = look(plane, points.requires_grad_(), box)
    torch.testing.assert_close(values[:, 0], torch.tensor([2.0, 2.0, 5.0]))
    values[:2].sum().backward()
    expected = torch.tensor([[0.75, 0.75], [0.25, 0.25]])  # 2 · (1 − x) (1 − y) and so on
    torch.testing.assert_close(plane.grad[:, :, 0, 0], expected)
    torch.testing.assert_close(points.grad[0], torch.tensor([4.0, 2.0, 0.0]))


@pytest.mark.parametrize("channels", [1, 3])
def test_it_is_exact_at_grid_points_and_goes_on_beyond_the_border(
    channels: int, rng: torch.Generator
) -> None:
    grid = torch.randn(3, 4, 5, channels, generator=rng)
    box = Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0))
    places = torch.cartesian_prod(torch.arange(3.0), torch.arange(4.0), torch.arange(5.0))
    assert torch.equal(interpolate(grid, places, box), grid.reshape(-1, channels))
    beyond = torch.tensor([[-5.0, 1.0, 1.0], [9.0, 1.0, 1.0], [1.0, -0.01, 7.0], [1e9, 1e9, -1e9]])
    expected = torch.stack([grid[0, 1, 1], grid[2, 1, 1], grid[1, 0, 4], grid[2, 3, 0]])
    assert torch.equal(interpolate(grid, beyond, box), expected)


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("count", [0, 1])
def test_no_point_and_one_point(channels: int, count: int, rng: torch.Generator) -> None:
    grid = torch.randn(*SHAPE, channels, generator=rng).requires_grad_()
    points = points_around(count, rng).requires_grad_()
    values = interpolate(grid, points, BOX)
    torch.testing.assert_close(values, trilinear.interpolate(grid, points, BOX))
    assert values.shape == (count, channels)
    values.sum().backward()
    assert points.grad.shape == (count, 3)
    # The weights of a point's corners are 1 together.
    assert grid.grad.sum().item() == pytest.approx(count * channels, abs=1e-5)


def test_only_what_needs_a_gradient_gets_one(rng: torch.Generator) -> None:
    grid, points = torch.randn(*SHAPE, 3, generator=rng), points_around(5, rng)
    assert not interpolate(grid, points, BOX).requires_grad
    interpolate(grid, points.requires_grad_(), BOX).sum().backward()
    assert points.grad is not None and grid.grad is None
    interpolate(grid.requires_grad_(), points.detach(), BOX).sum().backward()
    assert grid.grad is not None


def test_points_may_lie_in_memory_axis_by_axis(rng: torch.Generator) -> None:
    grid, points = torch.randn(*SHAPE, 3, generator=rng), points_around(50, rng)
    scattered = points.t().contiguous().t().requires_grad_()
    assert not scattered.is_contiguous()
    values = interpolate(grid, scattered, BOX)
    assert torch.equal(values, interpolate(grid, points, BOX))
    # So may gradients.
    factor = torch.randn(3, 50, generator=rng).t()
    (values * factor).sum().backward()
    together = points.clone().requires_grad_()
    (interpolate(grid, together, BOX) * factor).sum().backward()
    assert torch.equal(scattered.grad, together.grad)


def test_a_gradient_that_a_grid_has_is_added_to(rng: torch.Generator) -> None:
    grid, points = torch.randn(*SHAPE, 3, generator=rng).requires_grad_(), points_around(50, rng)
    interpolate(grid, points, BOX).sum().backward()
    first, place = grid.grad.clone(), grid.grad
    other = points_around(70, rng)
    (2 * interpolate(grid, other, BOX)).sum().backward()
    assert grid.grad is place
    fresh = grid.detach().clone().requires_grad_()
    (2 * interpolate(fresh, other, BOX)).sum().backward()
    torch.testing.assert_close(grid.grad, first + fresh.grad)
    assert fresh.grad.sum().item() == pytest.approx(2 * 70 * 3, rel=1e-4)


def test_where_a_gradient_is_kept_no_other_tensor_of_the_grids_size_is_made(
    rng: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[torch.Size] = []
    usual = torch.zeros_like
    monkeypatch.setattr(torch, "zeros_like", lambda one: made.append(one.shape) or usual(one))
    grid, points = torch.randn(*SHAPE, 3, generator=rng).requires_grad_(), points_around(50, rng)
    interpolate(grid, points, BOX).sum().backward()
    assert made == [grid.shape]
    interpolate(grid, points, BOX).sum().backward()
    assert made == [grid.shape]


def test_the_gradient_of_a_grid_that_is_computed_reaches_what_it_is_computed_of(
    rng: torch.Generator,
) -> None:
    small = torch.randn(*SHAPE, 3, generator=rng).requires_grad_()
    points = points_around(50, rng)
    for _ in range(2):  # the second time there is a gradient
        interpolate(2 * small, points, BOX).sum().backward()
    alone = small.detach().clone().requires_grad_()
    interpolate(alone, points, BOX).sum().backward()
    torch.testing.assert_close(small.grad, 4 * alone.grad)


@pytest.mark.parametrize("channels", CHANNELS)
def test_the_adjoint_adds_to_the_corners(channels: int, rng: torch.Generator) -> None:
    points, values = points_around(300, rng), torch.randn(300, channels, generator=rng)
    start = torch.randn(*SHAPE, channels, generator=rng)
    grid = start.clone()
    add_to_grid(grid, points, values, BOX)
    exact = torch.zeros(*SHAPE, channels, dtype=torch.float64, requires_grad=True)
    (trilinear.interpolate(exact, points.double(), BOX) * values).sum().backward()
    torch.testing.assert_close((grid - start).double(), exact.grad, atol=1e-5, rtol=0)


@pytest.mark.parametrize("interpolate", [interpolate, trilinear.interpolate])
def test_a_box_first_met_in_inference_mode_can_be_trained_in(
    interpolate: Callable[..., torch.Tensor],
) -> None:
    grid, box = torch.zeros(2, 3, 9, 1), Box((0.0, 0.0, 0.0), (1.0, 1.0, 8.0))
    grid[1] = 1.0
    grid[:, :, -1] += 5.0
    with torch.inference_mode():
        interpolate(grid, torch.ones(1, 3), box)
    points = torch.tensor([[0.5, 0.5, 7.5]], requires_grad=True)
    interpolate(grid, points, box).sum().backward()
    assert points.grad.tolist() == [[1.0, 0.0, 5.0]]

"""A smooth change of a grid: how far it goes, and what smoothness does."""

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.extensions.smooth_change import led_back, smooth_change

# Pixels to a unit of the grid's values.
SCALE = 50.0


def test_one_step_goes_a_pixel_downhill():
    target = torch.tensor([1.0, -1.0, 1.0]).expand(2, 2, 2, 3)
    change = smooth_change(
        lambda change, _: (change - target).square().sum(),
        like=torch.zeros(2, 2, 2, 3),
        scale=SCALE,
        steps=1,
        smoothness=0.0,
    )
    torch.testing.assert_close(change, target.sign() / SCALE)


def test_the_rate_falls_linearly_and_steps_are_counted():
    seen = []

    def misfit(change: Tensor, step: int) -> Tensor:
        seen.append(step)
        return change.sum()

    change = smooth_change(misfit, torch.zeros(1, 1, 1, 3), scale=1.0, steps=4, smoothness=0.0)
    assert seen == [0, 1, 2, 3]
    # A gradient of one: Adam goes the whole rate in each step.
    torch.testing.assert_close(change, torch.full_like(change, -(1 + 3 / 4 + 1 / 2 + 1 / 4)))


def test_neighbours_of_what_is_seen_follow_it_where_changes_are_smooth():
    def middle_is_a_pixel_further(change: Tensor, _: int) -> Tensor:
        return (change[2, 2, 2] * SCALE - 1).square().sum()

    def neighbour(smoothness: float) -> Tensor:
        like = torch.zeros(5, 5, 5, 3)
        change = smooth_change(middle_is_a_pixel_further, like, SCALE, 60, smoothness)
        return change[2, 2, 1] * SCALE

    torch.testing.assert_close(neighbour(0.0), torch.zeros(3))
    assert neighbour(1.0).min() > 0.5


def test_points_are_led_back_from_where_they_arrive(cube: Box, rng: torch.Generator):
    points = 0.5 * (2 * torch.rand(200, 3, generator=rng) - 1)
    grid = cube.grid_points((9, 9, 9), torch.empty(0)).view(9, 9, 9, 3)
    forward = torch.zeros_like(grid)
    forward[..., 0] = 0.2 + 0.1 * grid[..., 0]
    backward = led_back(
        torch.zeros_like(forward),
        forward,
        points=points,
        box=cube,
        scale=SCALE,
        steps=60,
        smoothness=1e-3,
    )
    arrived = points + interpolate(forward, points, cube)
    missed = arrived + interpolate(backward, arrived, cube) - points
    none = led_back(
        forward, forward, points=points[:0], box=cube, scale=SCALE, steps=1, smoothness=1.0
    )
    assert torch.equal(none, forward)
    assert float(missed.norm(dim=1).max()) * SCALE < 0.5

"""Candidates that a frame's visit starts from."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.kernels.look_up import look_up
from devrf.methods.devrf.extensions.frame_start import carried, smoothed


def test_a_translation_goes_on_as_it_was(cube: Box):
    way = torch.tensor([0.1, -0.2, 0.05])
    at_rest = torch.zeros(5, 5, 5, 3)
    backward, forward = carried((at_rest - way, at_rest + way), at_rest + way, cube)
    assert torch.allclose(forward, (2 * way).expand(5, 5, 5, 3))
    assert torch.allclose(backward, (-2 * way).expand(5, 5, 5, 3))


def test_both_directions_stay_each_others_inverse(cube: Box):
    # A turn about z by a at one frame, carried on by what the turn from a to 2 a is.
    points = cube.grid_points((15, 15, 15), torch.zeros(()))

    def turn(angle: float) -> torch.Tensor:
        c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
        matrix = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return points @ matrix.T - points

    first = (turn(-0.1), turn(0.1))
    backward, forward = carried(first, turn(0.2) - turn(0.1), cube)
    assert torch.allclose(forward, turn(0.2), atol=1e-6)
    inner = points[4:11, 4:11, 4:11].reshape(-1, 3)
    there = inner + look_up(forward, inner, cube)
    back = there + look_up(backward, there, cube)
    assert (back - inner).norm(dim=1).amax() < 2e-3


def test_smoothed_by_hand():
    grid = torch.zeros(3, 3, 3, 1)
    grid[0, 0, 0] = 8.0
    means = smoothed(grid)
    assert means[0, 0, 0, 0] == pytest.approx(8 * 8 / 27)  # a corner counts eight times
    assert means[1, 1, 1, 0] == pytest.approx(8 / 27)
    assert means[2, 2, 2, 0] == 0
    assert torch.equal(smoothed(torch.ones(2, 3, 2, 3)), torch.ones(2, 3, 2, 3))

"""Rigid poses: averages and relative poses by hand, motion against the matrix exponential."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch.autograd.functional import hessian

from devrf.geometry.poses import average_pose, relative_to, rigid_motion


def turned(angle: float, position: list[float]) -> torch.Tensor:
    """A pose turned about y by ``angle``."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    return torch.cat([rotation, torch.tensor(position, dtype=torch.float64)[:, None]], dim=1)


def test_the_average_of_two_turns_and_two_places() -> None:
    poses = torch.stack([turned(0.5, [0, 0, 0]), turned(0.1, [2, 4, 6])])
    torch.testing.assert_close(average_pose(poses), turned(0.3, [1, 2, 3]))
    # z axes agree, y axes lean to either side of the y axis: their mean is across.
    poses = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    for pose, angle in zip(poses, (0.4, -0.4), strict=True):
        c, s = math.cos(angle), math.sin(angle)
        pose[:2, :2] = torch.tensor([[c, -s], [s, c]])
    torch.testing.assert_close(average_pose(poses)[:, :3], torch.eye(3, dtype=torch.float64))


def test_a_pose_relative_to_another() -> None:
    pose = turned(0.7, [1, -2, 5])
    # The second camera is one unit to the right of the first, along its own x axis.
    beside = torch.cat([pose[:, :3], pose[:, 3:] + pose[:, :1]], dim=1)
    expected = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    expected[1, 0, 3] = 1
    torch.testing.assert_close(relative_to(pose, torch.stack([pose, beside])), expected)


def by_matrix(point: torch.Tensor, rotation: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """The point (3,) moved by the matrix exponential of the 4×4 twist."""
    (x, y, z), o = rotation, rotation.new_zeros(())
    turn = torch.stack([o, -z, y, z, o, -x, -y, x, o]).view(3, 3)
    twist = torch.cat([torch.cat([turn, velocity[:, None]], dim=1), rotation.new_zeros(1, 4)])
    return (torch.linalg.matrix_exp(twist) @ torch.cat([point, point.new_ones(1)]))[:3]


@pytest.mark.parametrize("size", [0.0, 0.005, 0.499, 0.501, 7.0])
def test_rigid_motion_is_the_exponential_of_the_twist(size: float, rng: torch.Generator) -> None:
    points, rotation, velocity = torch.randn(3, 5, 3, dtype=torch.float64, generator=rng).unbind()
    rotation = size * rotation / rotation.norm(dim=1, keepdim=True)
    moved = rigid_motion(points, rotation, velocity)
    for k in range(5):
        expected = by_matrix(points[k], rotation[k], velocity[k])
        torch.testing.assert_close(moved[k], expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("size", [0.0101, 0.49, 0.51])
def test_second_derivatives_keep_their_digits_in_single_precision(size: float) -> None:
    point, axis = torch.tensor([[0.5, -1.0, 2.0], [2.0, 1.0, -2.0]], dtype=torch.float64)

    def curvature(moved: Callable[..., torch.Tensor], dtype: torch.dtype) -> torch.Tensor:
        x, rotation = point.to(dtype), (size * axis / 3).to(dtype)
        return hessian(lambda r: moved(x, r, x.flip(0)).sum(), rotation).double()

    expected = curvature(by_matrix, torch.float64)
    for dtype, tolerance in ((torch.float64, 1e-8), (torch.float32, 2e-5)):
        found = curvature(rigid_motion, dtype)
        torch.testing.assert_close(found, expected, atol=tolerance, rtol=0)


def test_without_numbers_nothing_moves_and_gradients_are_there() -> None:
    point = torch.tensor([0.5, -1.0, 2.0])
    rotation, velocity = (torch.zeros(3, requires_grad=True) for _ in range(2))
    moved = rigid_motion(point, rotation, velocity)
    assert torch.equal(moved, point)
    # To first order x′ = x + r × x + v: of x′₁ this is r₂ x₃ − r₃ x₂ + v₁.
    by_rotation, by_velocity = torch.autograd.grad(moved[0], (rotation, velocity))
    torch.testing.assert_close(by_rotation, torch.tensor([0.0, 2.0, 1.0]))
    torch.testing.assert_close(by_velocity, torch.tensor([1.0, 0.0, 0.0]))

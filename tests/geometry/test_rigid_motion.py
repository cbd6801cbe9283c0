"""Rigid motion: a rotation vector and a velocity, as the exponential of se(3)."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.liegroup import Se3

from devrf.geometry.rigid_motion import rigid_motion


def by_matrix(point: torch.Tensor, rotation: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """The point (3,) moved by the matrix exponential of the 4×4 twist."""
    x, y, z = rotation.tolist()
    twist = torch.tensor(
        [[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0]], dtype=point.dtype
    )
    twist[:3, 3] = velocity
    return (torch.linalg.matrix_exp(twist) @ torch.cat([point, point.new_ones(1)]))[:3]


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.005, 0.02, 1.0, 3.0, 7.0])
def test_it_is_the_exponential_of_the_twist(size: float, rng: torch.Generator) -> None:
    points, rotation, velocity = torch.randn(3, 5, 3, dtype=torch.float64, generator=rng).unbind()
    rotation = size * rotation / rotation.norm(dim=1, keepdim=True)
    found = rigid_motion(points, rotation, velocity)
    for k in range(5):
        expected = by_matrix(points[k], rotation[k], velocity[k])
        torch.testing.assert_close(found[k], expected, atol=1e-8, rtol=0)


def test_kornia_moves_points_alike(rng: torch.Generator) -> None:
    points, rotation, velocity = torch.randn(3, 6, 3, generator=rng).unbind()
    motion = Se3.exp(torch.cat([velocity, rotation], dim=1))
    expected = torch.stack([motion[k] * points[k] for k in range(6)])
    torch.testing.assert_close(
        rigid_motion(points, rotation, velocity), expected.squeeze(), atol=1e-5, rtol=1e-5
    )


def test_a_quarter_turn_by_hand() -> None:
    turn = torch.tensor([0.0, 0.0, math.pi / 2])
    moved = rigid_motion(torch.tensor([1.0, 0.0, 2.0]), turn, torch.zeros(3))
    torch.testing.assert_close(moved, torch.tensor([0.0, 1.0, 2.0]))


def test_without_numbers_nothing_moves_and_gradients_are_there() -> None:
    point = torch.tensor([0.5, -1.0, 2.0])
    rotation, velocity = (torch.zeros(3, requires_grad=True) for _ in range(2))
    moved = rigid_motion(point, rotation, velocity)
    assert torch.equal(moved, point)
    # To first order x′ = x + r × x + v: of x′₁ this is r₂ x₃ − r₃ x₂ + v₁.
    by_rotation, by_velocity = torch.autograd.grad(moved[0], (rotation, velocity))
    torch.testing.assert_close(by_rotation, torch.tensor([0.0, 2.0, 1.0]))
    torch.testing.assert_close(by_velocity, torch.tensor([1.0, 0.0, 0.0]))

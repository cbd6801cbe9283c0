"""The elastic loss: what it is for motions that are known, and how samples are drawn for it."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.poses import rigid_motion
from devrf.methods.nerfies.elastic import drawn, jacobians, robust, strain


def test_a_rigid_motion_has_no_strain() -> None:
    points = torch.rand(6, 3, dtype=torch.float64)
    turn, shift = torch.tensor([[1.0, -2.0, 0.5], [0.3, 0.0, -1.0]], dtype=torch.float64)
    found = jacobians(lambda x: rigid_motion(x, turn.expand_as(x), shift.expand_as(x)), points)
    product = found.transpose(1, 2) @ found
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert strain(found).abs().max() < 1e-20


def test_the_columns_of_a_jacobian_belong_to_the_axes_of_the_point() -> None:
    # x′ = (x y, z, 2 x) at (1, 2, 3).
    points = torch.tensor([[1.0, 2.0, 3.0]])

    def warp(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([x[:, 0] * x[:, 1], x[:, 2], 2 * x[:, 0]], dim=-1)

    assert jacobians(warp, points)[0].tolist() == [[2.0, 1.0, 0.0], [0.0, 0.0, 1.0], [2.0, 0, 0]]


def test_growing_by_e_along_all_axes_is_a_strain_of_three() -> None:
    torch.testing.assert_close(strain(math.e * torch.eye(3)[None]), torch.tensor([3.0]))


def test_the_strain_of_no_motion_has_a_finite_gradient() -> None:
    jacobian = torch.eye(3)[None].requires_grad_()
    strain(jacobian).sum().backward()
    assert jacobian.grad is not None and torch.equal(jacobian.grad, torch.zeros(1, 3, 3))


def test_the_robust_loss_by_hand() -> None:
    found = robust(torch.tensor([0.0, 4 * 0.03**2, 1e9]), 0.03)
    torch.testing.assert_close(found, torch.tensor([0.0, 1.0, 2.0]))


def test_one_sample_of_each_ray_is_drawn_by_weight() -> None:
    weight = torch.tensor([0.1, 0.3, 0.0, 0.0, 0.5])
    ray = torch.tensor([0, 0, 1, 2, 2])  # ray 1 has no weight, ray 3 no sample
    rays = torch.tensor([2, 0, 1, 3]).repeat(4000)
    sample, mass = drawn(weight, ray, rays, 4)
    counts = torch.bincount(sample, minlength=5)
    assert counts.tolist()[2:] == [0, 0, 4000] and counts[:2].sum() == 4000
    assert counts[1].item() == pytest.approx(3000, abs=120)
    torch.testing.assert_close(mass[sample < 2], torch.full((4000,), 0.4))
    torch.testing.assert_close(mass[sample == 4], torch.full((4000,), 0.5))

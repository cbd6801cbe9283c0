"""Gaussians in pictures against values computed by hand, and their gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from devrf.geometry.cameras import Cameras
from devrf.ops.splatting import Gaussians, SplatImage, rotations, splat

# At the origin, looking along −z: a focal length of 40 pixels, 5 × 5 pixels.
POSE = torch.eye(4)[None, :3]
CAMERA = Cameras(POSE, torch.tensor([[40.0, 40.0]]), torch.tensor([[2.5, 2.5]]), 5, 5)


def round_ones(*depths: float, opacity: float = 0.5) -> Gaussians:
    """Round, grey Gaussians on the optical axis, each a pixel wide: V = 1 + 0.3."""
    depth = torch.tensor(depths)
    count = len(depths)
    means = torch.stack([torch.zeros(count), torch.zeros(count), -depth], dim=1)
    scales = (depth / 40)[:, None].expand(count, 3)
    turns = torch.tensor([[2.0, 0.0, 0.0, 0.0]]).expand(count, 4)
    return Gaussians(means, scales, turns, torch.full((count,), opacity), torch.ones(count, 3))


def alpha(image: SplatImage) -> Tensor:
    """Opacities (5, 5)."""
    return (1 - image.transmittance).view(5, 5)


def test_a_round_gaussian_falls_off_by_its_covariance_and_a_third_of_a_pixel() -> None:
    gaussian = replace(round_ones(4.0), color=torch.tensor([[0.2, 0.4, 1.0]]))
    image = splat(gaussian, CAMERA, 0.1)
    seen = alpha(image)
    assert seen[2, 2] == pytest.approx(0.5)
    for row, column in ((2, 3), (2, 1), (1, 2), (3, 2)):
        assert seen[row, column].item() == pytest.approx(0.5 * math.exp(-0.5 / 1.3))
    assert seen[0, 4].item() == pytest.approx(0.5 * math.exp(-4 / 1.3))
    middle = image.color.view(5, 5, 3)[2, 2]
    torch.testing.assert_close(middle, torch.tensor([0.1, 0.2, 0.5]))
    assert image.depth.view(5, 5)[2, 2].item() == pytest.approx(2.0)


def test_axes_turn_and_the_shift_moves_the_picture() -> None:
    # Two pixels long along its x axis, which a quarter turn about z makes the world's y axis.
    quarter = torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]])
    torch.testing.assert_close(
        rotations(quarter)[0], torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    )
    scales = torch.tensor([[0.2, 0.1, 0.1]])
    gaussian = replace(round_ones(4.0), scales=scales, quaternions=quarter)
    seen = alpha(splat(gaussian, CAMERA, 0.1))
    assert seen[3, 2].item() == pytest.approx(0.5 * math.exp(-0.5 / 4.3))
    assert seen[2, 3].item() == pytest.approx(0.5 * math.exp(-0.5 / 1.3))
    moved = splat(gaussian, CAMERA, 0.1, shift=torch.tensor([[1.0, -2.0]]))
    torch.testing.assert_close(alpha(moved)[0, 3], seen[2, 2])


def test_near_ones_hide_far_ones_whatever_their_order() -> None:
    gaussians = replace(round_ones(6.0, 4.0, opacity=0.8), color=torch.eye(3)[:2])
    image = splat(gaussians, CAMERA, 0.1)
    assert image.color.view(5, 5, 3)[2, 2].tolist() == pytest.approx([0.16, 0.8, 0.0])
    assert image.depth.view(5, 5)[2, 2].item() == pytest.approx(0.8 * 4 + 0.16 * 6)
    assert image.transmittance.view(5, 5)[2, 2].item() == pytest.approx(0.04)


def test_what_is_opaque_faint_hidden_or_too_near() -> None:
    assert alpha(splat(round_ones(4.0, opacity=1.0), CAMERA, 0.1))[2, 2] == pytest.approx(0.99)
    faint = alpha(splat(round_ones(4.0, opacity=0.004), CAMERA, 0.1))
    assert faint[2, 2].item() == pytest.approx(0.004, rel=1e-4) and faint.count_nonzero() == 1
    # 0.02³ is less than 1e-4: the fourth does not count.
    deep = splat(round_ones(4.0, 5.0, 6.0, 7.0, opacity=0.98), CAMERA, 0.1)
    assert deep.transmittance.view(5, 5)[2, 2].item() == pytest.approx(8e-6, rel=1e-3)
    nothing = splat(round_ones(0.05, -4.0, 0.0), CAMERA, 0.1)
    assert not nothing.color.any() and (nothing.transmittance == 1).all()


def test_gradients(rng: torch.Generator) -> None:
    count = 3
    place = torch.tensor([0.1, 0.0, -4.0], dtype=torch.float64)
    tensors = [
        place + 0.1 * torch.randn(count, 3, generator=rng, dtype=torch.float64),
        0.1 + 0.1 * torch.rand(count, 3, generator=rng, dtype=torch.float64),
        torch.randn(count, 4, generator=rng, dtype=torch.float64),
        0.3 + 0.5 * torch.rand(count, generator=rng, dtype=torch.float64),
        torch.rand(count, 3, generator=rng, dtype=torch.float64),
        torch.zeros(count, 2, dtype=torch.float64),
    ]

    def pictures(*inputs: Tensor) -> tuple[Tensor, ...]:
        image = splat(Gaussians(*inputs[:5]), CAMERA, 0.1, shift=inputs[5])
        return image.color, image.depth, image.transmittance

    assert gradcheck(pictures, [each.requires_grad_() for each in tensors])


def test_a_quaternion_of_zero_is_no_rotation_and_a_long_one_is_normalised() -> None:
    assert torch.equal(rotations(torch.zeros(4)), torch.eye(3))
    # A quarter turn about z, three times as long as a unit quaternion: x becomes y.
    half = 3 * math.sqrt(0.5)
    turned = rotations(torch.tensor([half, 0, 0, half])) @ torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]))

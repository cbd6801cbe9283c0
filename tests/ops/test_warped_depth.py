"""Warp and optical depth: by hand, and its gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.ops.warped_depth import warped_depth

UNIT = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def ramp() -> Tensor:
    """Raw density 4·x on the unit box."""
    return 4 * torch.tensor([0.0, 1.0]).view(2, 1, 1, 1).expand(2, 2, 2, 1).contiguous()


def shifted(by: float) -> Tensor:
    """A slice that moves everything by ``by`` along x."""
    return torch.tensor([by, 0.0, 0.0]).expand(2, 2, 2, 3).contiguous()


def test_between_two_frames_by_hand() -> None:
    points = torch.tensor([[0.1, 0.5, 0.5]])
    slices = [shifted(0.1), shifted(0.5)]
    q, tau = warped_depth(points, ramp(), slices, 0.25, box=UNIT, shift=0.0, delta=2.0)
    # 0.1 + 0.75·0.1 + 0.25·0.5 = 0.3, where the raw density is 1.2.
    torch.testing.assert_close(q, torch.tensor([[0.3, 0.5, 0.5]]))
    assert tau.item() == pytest.approx(2 * math.log1p(math.exp(1.2)))


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_gradients(rng: torch.Generator, frames: int) -> None:
    points = 0.1 + 0.8 * torch.rand(3, 3, generator=rng, dtype=torch.float64)
    density = torch.randn(2, 2, 3, 1, generator=rng, dtype=torch.float64, requires_grad=True)
    slices = [
        (0.1 * torch.randn(2, 2, 2, 3, generator=rng, dtype=torch.float64)).requires_grad_()
        for _ in range(frames)
    ]

    def work(density: Tensor, *slices: Tensor) -> tuple[Tensor, ...]:
        q, tau = warped_depth(points, density, slices, 0.3, box=UNIT, shift=-0.5, delta=0.7)
        return (q, tau) if slices else (tau,)

    assert gradcheck(work, (density, *slices))


def test_gradients_added_to_buffers() -> None:
    density, frame = ramp().requires_grad_(), shifted(0.0).requires_grad_()
    buffers = torch.ones(2, 2, 2, 1), torch.ones(2, 2, 2, 3)
    _, tau = warped_depth(
        torch.tensor([[0.25, 0.0, 0.0]]),
        density,
        [frame],
        box=UNIT,
        shift=-1.0,
        delta=0.5,
        density_gradient=buffers[0],
        slice_gradients=buffers[1:],
    )
    tau.sum().backward()
    assert density.grad is None and frame.grad is None
    # δ · sigmoid(0) to the density, times its slope 4 to x; three quarters at the low corner.
    assert buffers[0][0, 0, 0, 0].item() == pytest.approx(1 + 0.5 * 0.5 * 0.75)
    assert buffers[1][0, 0, 0].tolist() == pytest.approx([1.75, 1.0, 1.0])


def test_slices_of_different_shapes_are_refused() -> None:
    slices = [torch.zeros(2, 2, 2, 3), torch.zeros(3, 2, 2, 3)]
    with pytest.raises(DevrfError, match=r"two slices of one shape, not \(2, 2, 2, 3\), \(3"):
        warped_depth(torch.zeros(1, 3), ramp(), slices, box=UNIT, shift=0.0, delta=1.0)

"""What the colour network gets from a ray, and gives back to it."""

from __future__ import annotations

import torch

from devrf.ops.color_network import RowOfRay


def test_a_rays_gradient_is_summed_without_losing_digits() -> None:
    # 256 + 1 is 256 in bfloat16: a running sum of ones stays there.
    rows = torch.zeros(2, 1, dtype=torch.bfloat16, requires_grad=True)
    ray = torch.tensor([0] * 2048 + [1] * 3)
    RowOfRay.apply(rows, ray).sum().backward()
    assert rows.grad is not None and rows.grad.dtype == torch.bfloat16
    assert rows.grad.flatten().tolist() == [2048.0, 3.0]


def test_its_gradient_is_right() -> None:
    rows = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    ray = torch.tensor([0, 0, 2, 2, 2])
    assert torch.autograd.gradcheck(lambda r: RowOfRay.apply(r, ray), (rows,), atol=1e-4)

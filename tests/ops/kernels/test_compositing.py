"""The compositing kernels against their PyTorch twin."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from devrf.ops.compositing import composite, composite_segments, sum_segments

Draw = Callable[..., Tensor]
Both = Callable[[Callable[[], tuple[Tensor, ...]]], None]

# Rays without samples at either end and in between; one block of lanes, one more, two and more.
LENGTHS = torch.tensor([0, 3, 0, 0, 32, 33, 1, 70, 0])


def segments(device: torch.device, lengths: Tensor = LENGTHS) -> Tensor:
    return torch.nn.functional.pad(lengths.cumsum(0), (1, 0)).to(device)


def opaque_and_faint(draw: Draw, samples: int) -> Tensor:
    """Optical depths from 1e-6 to 5, some as good as infinite."""
    depth = 5 * draw(samples).abs() ** 8 + 1e-6
    depth[::25] = 300.0
    return depth


@pytest.mark.parametrize("padding", [0, 5])
def test_weights_and_gradients(draw: Draw, agree: Both, device: torch.device, padding: int) -> None:
    first = segments(device)
    samples = int(first[-1]) + padding
    depth, to_weights, to_end = opaque_and_faint(draw, samples), draw(samples), draw(9)

    def work() -> tuple[Tensor, ...]:
        leaf = depth.clone().requires_grad_()
        weights, end = composite_segments(leaf, first)
        loss = (weights * to_weights).sum() + (end * to_end).sum()
        return weights.detach(), end.detach(), *torch.autograd.grad(loss, leaf)

    agree(work)


@pytest.mark.parametrize("channels", [1, 3, 12])
def test_sums_and_gradients(draw: Draw, agree: Both, device: torch.device, channels: int) -> None:
    first = segments(device)
    samples = int(first[-1]) + 4
    weights, values, upstream = draw(samples), draw(samples, channels), draw(9, channels)

    def work() -> tuple[Tensor, ...]:
        leaves = weights.clone().requires_grad_(), values.clone().requires_grad_()
        sums = sum_segments(*leaves, first)
        return sums.detach(), *torch.autograd.grad(sums, leaves, upstream)

    agree(work)


def test_rays_given_sample_by_sample(draw: Draw, agree: Both, device: torch.device) -> None:
    ray = torch.repeat_interleave(LENGTHS).to(device)
    depth = opaque_and_faint(draw, len(ray))
    agree(lambda: composite(depth, ray, 9))


@pytest.mark.parametrize("rays", [0, 2])
def test_no_samples(draw: Draw, agree: Both, device: torch.device, rays: int) -> None:
    first = segments(device, torch.zeros(rays, dtype=torch.long))
    agree(lambda: composite_segments(draw(0), first))
    agree(lambda: (sum_segments(draw(0), draw(0, 3), first),))

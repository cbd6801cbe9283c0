"""Compositing against values computed by hand, and its gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import gradcheck

from devrf.ops.compositing import (
    composite,
    sum_by_doubling,
    transmittances,
)

# Three rays: three samples, none, two.
RAY = torch.tensor([0, 0, 0, 2, 2])


def test_opacities_by_hand_on_two_rays_with_an_empty_one_between() -> None:
    alpha = torch.tensor([0.5, 0.2, 0.1, 0.25, 0.6])
    depth = -torch.log1p(-alpha)
    weights, end = composite(depth, RAY, 3)
    # 0.5, 0.5·0.2, 0.5·0.8·0.1; on the last ray 0.25, 0.75·0.6.
    torch.testing.assert_close(weights, torch.tensor([0.5, 0.1, 0.04, 0.25, 0.45]))
    torch.testing.assert_close(end, torch.tensor([0.36, 1.0, 0.3]))
    before = transmittances(depth, RAY, 3)
    torch.testing.assert_close(before, torch.tensor([1.0, 0.5, 0.4, 1.0, 0.75]))


def test_a_faint_ray_keeps_its_digits_behind_many_opaque_ones() -> None:
    # Running sums over all rays reach 1e6 here; float32 sums would lose the last ray's 1e-4.
    depth = torch.cat([torch.full((10_000,), 100.0), torch.tensor([1e-4, 2e-4])])
    ray = torch.cat([torch.arange(10_000), torch.tensor([10_000, 10_000])])
    weights, end = composite(depth, ray, 10_001)
    expected = torch.tensor([-math.expm1(-1e-4), -math.expm1(-2e-4) * math.exp(-1e-4)])
    torch.testing.assert_close(weights[-2:], expected, rtol=1e-6, atol=0)
    assert end[-1].item() == pytest.approx(math.exp(-3e-4), abs=1e-7)


def test_gradients(rng: torch.Generator) -> None:
    depth = torch.rand(5, generator=rng, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda tau: composite(tau, RAY, 3), (depth,))


@pytest.mark.parametrize("count", [0, 1, 7, 8, 1000])
def test_running_sums_by_doubling(rng: torch.Generator, count: int) -> None:
    values = torch.rand(count, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(sum_by_doubling(values), values.cumsum(0), rtol=1e-14, atol=0)

"""Two densities in one pass: by hand, and where one of them is alone."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.methods.nsff.fields import blended, closed, shared
from devrf.ops.compositing import composite, sum_by_ray

RAY = torch.tensor([0, 0, 0, 1, 1])


def depths() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor([0.1, 2.0, 0.3, 5.0, 0.0]), torch.tensor([0.4, 0.0, 1.0, 0.2, 3.0])


@pytest.mark.parametrize("v", [0.0, 1.0])
def test_a_share_of_nothing_or_all_is_a_single_field(v: float) -> None:
    dynamic, static = depths()
    blend = blended(*shared(dynamic, static, torch.full((5,), v)), RAY, 2)
    weight, end = composite(static if v == 0 else dynamic, RAY, 2)
    found, other = (blend.static, blend.dynamic) if v == 0 else (blend.dynamic, blend.static)
    torch.testing.assert_close(found, weight)
    torch.testing.assert_close(blend.transmittance, end)
    assert other.abs().max() < 1e-6


@pytest.mark.parametrize("additive", [False, True])
def test_weights_and_what_is_behind_sum_to_one(additive: bool) -> None:
    dynamic, static = depths()
    if not additive:
        dynamic, static = shared(dynamic, static, torch.tensor([0.2, 0.5, 0.9, 0.4, 0.7]))
    blend = blended(dynamic, static, RAY, 2)
    total = sum_by_ray(blend.dynamic + blend.static, RAY, 2) + blend.transmittance
    torch.testing.assert_close(total, torch.ones(2))


def test_opacities_are_scaled_by_their_shares() -> None:
    # 1 − e^{−ln 2} = 1/2; of it a quarter is dynamic (1/8), three quarters are static (3/8).
    half = torch.tensor([math.log(2)])
    dynamic, static = shared(half, half, torch.tensor([0.25]))
    assert (1 - torch.exp(-dynamic)).item() == pytest.approx(1 / 8)
    assert (1 - torch.exp(-static)).item() == pytest.approx(3 / 8)
    blend = blended(dynamic, static, torch.tensor([0]), 1)
    assert blend.transmittance.item() == pytest.approx(7 / 8 * 5 / 8)
    # What is absorbed, 1 − 35/64, is divided as 1 to 3.
    assert blend.dynamic.item() == pytest.approx((1 - 35 / 64) / 4)


def test_an_unbounded_last_sample_leaves_nothing_to_see() -> None:
    """On ray 0 of three; ray 1 has no sample, ray 2 an opaque one of which a quarter is dynamic."""
    ray, v = torch.tensor([0, 0, 2]), torch.tensor([0.5, 0.5, 0.25])
    unbounded = torch.tensor([0.0, 1e10, 1e10])
    blend = closed(blended(*shared(unbounded, unbounded, v), ray, 3), v, ray)
    torch.testing.assert_close(blend.transmittance, torch.tensor([0.0, 1.0, 0.0]))
    total = blend.dynamic + blend.static
    torch.testing.assert_close(total, torch.tensor([0.0, 1.0, 1.0]))
    torch.testing.assert_close(blend.dynamic[2], torch.tensor(0.25))


def test_added_densities_divide_what_they_absorb() -> None:
    blend = blended(torch.tensor([math.log(2)]), torch.tensor([math.log(2)]), torch.tensor([0]), 1)
    assert blend.transmittance.item() == pytest.approx(1 / 4)
    assert blend.dynamic.item() == pytest.approx(3 / 8)


def test_an_unbounded_sample_has_finite_gradients() -> None:
    dynamic = torch.tensor([1e10, 0.0], requires_grad=True)
    static = torch.tensor([0.0, 1e10], requires_grad=True)
    v = torch.tensor([1.0, 0.3], requires_grad=True)
    blend = blended(*shared(dynamic, static, v), torch.tensor([0, 1]), 2)
    (blend.dynamic.sum() + blend.static.sum()).backward()
    for value in (dynamic, static, v):
        assert value.grad is not None and bool(value.grad.isfinite().all())

"""The colour network: what a sample's feature and its ray's direction become."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from devrf.ops import color_network
from devrf.ops.color_network import TILE, ColorNetwork, decode


def network(*, dtype: torch.dtype = torch.float64) -> ColorNetwork:
    """One feature, one octave, two hidden units, whose first looks at sin(d_x) alone."""
    direction = torch.zeros(2, 9, dtype=dtype)
    direction[0, 3] = 2.0  # after d itself come the sines
    return ColorNetwork(
        feature_weight=torch.tensor([[1.0], [-1.0]], dtype=dtype),
        feature_bias=torch.tensor([0.5, 0.0], dtype=dtype),
        direction_weight=direction,
        hidden_weight=torch.eye(2, dtype=dtype),
        hidden_bias=torch.zeros(2, dtype=dtype),
        output_weight=torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=dtype),
        output_bias=torch.zeros(3, dtype=dtype),
        octaves=torch.ones(1, dtype=dtype),
    )


def test_a_color_by_hand() -> None:
    viewdirs = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    color = decode(
        torch.tensor([[0.25]], dtype=torch.float64), viewdirs, torch.tensor([1]), network()
    )
    first = 0.25 + 0.5 + 2 * math.sin(1.0)  # the second unit, −0.25, is cut off
    expected = [1 / (1 + math.exp(-logit)) for logit in (first, 0.0, first)]
    assert color.tolist() == [pytest.approx(expected)]


def test_rays_without_samples_do_not_matter_and_no_sample_is_no_color() -> None:
    viewdirs = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=1)
    features = torch.randn(3, 1, dtype=torch.float64)
    among_others = decode(features, viewdirs, torch.tensor([1, 1, 3]), network())
    alone = decode(features, viewdirs[[1, 3]], torch.tensor([0, 0, 1]), network())
    assert torch.equal(among_others, alone)
    assert decode(features[:0], viewdirs, torch.zeros(0, dtype=torch.int64), network()).shape == (
        0,
        3,
    )


@pytest.mark.parametrize("shaded", [False, True])
def test_colors_of_a_picture_are_found_tile_by_tile(
    shaded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    usual = color_network._color

    def color(features: torch.Tensor, *others: Any) -> torch.Tensor:
        sizes.append(len(features))
        return usual(features, *others)

    monkeypatch.setattr(color_network, "_color", color)
    generator = torch.Generator().manual_seed(0)
    samples = 2 * TILE + 5
    features = torch.randn(samples, 1, generator=generator)
    viewdirs = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=1)
    ray = torch.arange(samples) * 50 // samples
    residual = torch.randn(samples, 3, generator=generator) if shaded else None
    single = network(dtype=torch.float32)
    together = decode(features, viewdirs, ray, single, residual=residual)
    with torch.no_grad():
        tiles = decode(features, viewdirs, ray, single, residual=residual)
    assert sizes == [samples, TILE, TILE, 5]
    torch.testing.assert_close(tiles, together, rtol=0, atol=1e-6)


def test_gradients() -> None:
    viewdirs = torch.nn.functional.normalize(torch.randn(2, 3, dtype=torch.float64), dim=1)
    features = torch.randn(3, 1, dtype=torch.float64, requires_grad=True)
    residual = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    weights = network()._replace(
        direction_weight=torch.randn(2, 9, dtype=torch.float64, requires_grad=True),
        hidden_weight=torch.randn(2, 2, dtype=torch.float64, requires_grad=True),
    )
    ray = torch.tensor([0, 0, 1])

    def colors(f: torch.Tensor, r: torch.Tensor, d: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        varied = weights._replace(direction_weight=d, hidden_weight=h)
        return decode(f, viewdirs, ray, varied, r)

    inputs = (features, residual, weights.direction_weight, weights.hidden_weight)
    assert torch.autograd.gradcheck(colors, inputs)


def test_without_samples_gradients_are_zero() -> None:
    features, layers = torch.zeros(0, 1, requires_grad=True), network(dtype=torch.float32)
    layers.direction_weight.requires_grad_()
    decode(features, torch.eye(3), torch.zeros(0, dtype=torch.int64), layers).sum().backward()
    assert features.grad.shape == (0, 1) and not layers.direction_weight.grad.any()

"""The colour decoder: what a sample's feature and its ray's direction become."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch.func import functional_call

from devrf.methods.devrf.color_decoder import TILE, ColorDecoder


def by_hand(*, dtype: torch.dtype = torch.float64) -> ColorDecoder:
    """One feature, one octave, two hidden units, whose first looks at sin(d_x) alone."""
    decoder = ColorDecoder(channels=1, width=2, frequencies=1).to(dtype)
    direction = torch.zeros(2, 9)
    direction[0, 3] = 2.0  # after d itself come the sines
    values = {
        "from_feature.weight": torch.tensor([[1.0], [-1.0]]),
        "from_feature.bias": torch.tensor([0.5, 0.0]),
        "from_direction.weight": direction,
        "hidden.weight": torch.eye(2),
        "hidden.bias": torch.zeros(2),
        "output.weight": torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
        "output.bias": torch.zeros(3),
    }
    decoder.load_state_dict(values)
    return decoder


def test_a_color_by_hand() -> None:
    viewdirs = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    color = by_hand()(torch.tensor([[0.25]], dtype=torch.float64), viewdirs, torch.tensor([1]))
    first = 0.25 + 0.5 + 2 * math.sin(1.0)  # the second unit, −0.25, is cut off
    expected = [1 / (1 + math.exp(-logit)) for logit in (first, 0.0, first)]
    assert color.tolist() == [pytest.approx(expected)]


def test_rays_without_samples_do_not_matter_and_no_sample_is_no_color() -> None:
    decode = by_hand()
    viewdirs = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=1)
    features = torch.randn(3, 1, dtype=torch.float64)
    among_others = decode(features, viewdirs, torch.tensor([1, 1, 3]))
    alone = decode(features, viewdirs[[1, 3]], torch.tensor([0, 0, 1]))
    assert torch.equal(among_others, alone)
    assert decode(features[:0], viewdirs, torch.zeros(0, dtype=torch.int64)).shape == (0, 3)


@pytest.mark.parametrize("shaded", [False, True])
def test_colors_of_a_picture_are_found_tile_by_tile(
    shaded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    usual = ColorDecoder._color

    def color(decoder: ColorDecoder, features: torch.Tensor, *others: Any) -> torch.Tensor:
        sizes.append(len(features))
        return usual(decoder, features, *others)

    monkeypatch.setattr(ColorDecoder, "_color", color)
    generator = torch.Generator().manual_seed(0)
    samples = 2 * TILE + 5
    features = torch.randn(samples, 1, generator=generator)
    viewdirs = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=1)
    ray = torch.arange(samples) * 50 // samples
    residual = torch.randn(samples, 3, generator=generator) if shaded else None
    single = by_hand(dtype=torch.float32)
    together = single(features, viewdirs, ray, residual=residual)
    with torch.no_grad():
        tiles = single(features, viewdirs, ray, residual=residual)
    assert sizes == [samples, TILE, TILE, 5]
    torch.testing.assert_close(tiles, together, rtol=0, atol=1e-6)


def test_gradients() -> None:
    viewdirs = torch.nn.functional.normalize(torch.randn(2, 3, dtype=torch.float64), dim=1)
    decoder = by_hand()
    names = ("from_direction.weight", "hidden.weight")
    weights = [torch.randn(2, size, dtype=torch.float64) for size in (9, 2)]
    ray = torch.tensor([0, 0, 1])

    def colors(f: torch.Tensor, r: torch.Tensor, *varied: torch.Tensor) -> torch.Tensor:
        color: torch.Tensor = functional_call(
            decoder, dict(zip(names, varied, strict=True)), (f, viewdirs, ray, r)
        )
        return color

    inputs = [torch.randn(3, size, dtype=torch.float64) for size in (1, 3)] + weights
    assert torch.autograd.gradcheck(colors, [each.requires_grad_() for each in inputs])


def test_without_samples_gradients_are_zero() -> None:
    features, decoder = torch.zeros(0, 1, requires_grad=True), by_hand(dtype=torch.float32)
    decoder(features, torch.eye(3), torch.zeros(0, dtype=torch.int64)).sum().backward()
    assert features.grad is not None and features.grad.shape == (0, 1)
    assert not decoder.from_direction.weight.grad.any()

"""Encodings, trunks and codes, by hand."""

from __future__ import annotations

import math

import torch
from torch import nn

from devrf.methods.nerf.networks import (
    SinusoidalEncoding,
    TimeCodes,
    Trunk,
    initialise,
    linear_by_ray,
    mlp,
    octave_window,
)


def test_two_octaves_of_a_number() -> None:
    encode, x = SinusoidalEncoding(1, 2), 0.3
    expected = [x, math.sin(x), math.sin(2 * x), math.cos(x), math.cos(2 * x)]
    torch.testing.assert_close(encode(torch.tensor([[x]]))[0], torch.tensor(expected))
    assert encode.size == 5
    points = torch.tensor([[0.1, -0.2, 0.3]])
    assert torch.equal(SinusoidalEncoding(3, 0)(points), points)  # no octaves


def test_the_frequency_of_the_first_octave() -> None:
    encoded = SinusoidalEncoding(1, 2, first=math.pi)(torch.tensor([[0.25]]))[0]
    half = math.sqrt(0.5)  # an eighth of a turn, then a quarter; the number itself has no factor
    torch.testing.assert_close(encoded, torch.tensor([0.25, half, 1.0, half, 0.0]))


def test_a_layer_by_ray_is_that_of_one_long_input() -> None:
    layer, ray = nn.Linear(9, 4), torch.tensor([0, 0, 2, 2, 2])
    inputs = [torch.randn(5, 2), torch.randn(5, 4), torch.randn(3, 3)]
    first, second, of_rays = (each.requires_grad_() for each in inputs)
    whole = layer(torch.cat([first, second, of_rays[ray]], dim=1))
    parts = linear_by_ray(layer, [first, second], of_rays, ray)
    torch.testing.assert_close(parts, whole)
    learned = [*inputs, *layer.parameters()]
    expected = torch.autograd.grad(whole.square().sum(), learned)
    torch.testing.assert_close(torch.autograd.grad(parts.square().sum(), learned), expected)


def test_a_window_opens_octaves_from_coarse_to_fine() -> None:
    for opened, window in ((0.0, [0, 0, 0]), (1.5, [1, 0.5, 0]), (3.0, [1, 1, 1])):
        expected = torch.tensor(window, dtype=torch.float32)
        torch.testing.assert_close(octave_window(torch.tensor(opened), 3), expected)


def test_a_window_weighs_all_numbers_of_an_octave_and_not_the_vector() -> None:
    x, y = 0.3, -0.8
    values, window = torch.tensor([[x, y]]), torch.tensor([1.0, 0.5])
    encoded = SinusoidalEncoding(2, 2, identity=False)(values, window)
    sines = [math.sin(x), math.sin(y), 0.5 * math.sin(2 * x), 0.5 * math.sin(2 * y)]
    cosines = [math.cos(x), math.cos(y), 0.5 * math.cos(2 * x), 0.5 * math.cos(2 * y)]
    torch.testing.assert_close(encoded[0], torch.tensor(sines + cosines))
    assert torch.equal(SinusoidalEncoding(2, 2)(values, torch.zeros(2))[:, :2], values)


def test_the_input_enters_the_layer_that_was_asked_for() -> None:
    for skip, depth, widths in (
        (5, 6, [3, 8, 8, 8, 8, 11]),
        (None, 6, [3, 8, 8, 11, 8, 8]),
        (4, 2, [3, 8]),
    ):
        assert [layer.in_features for layer in Trunk(3, 8, depth, skip).layers] == widths


def test_a_second_input_of_zeros_changes_nothing_and_its_weights_are_apart() -> None:
    trunk, values = Trunk(3, 8, 4, None, beside=2), torch.rand(5, 3)
    assert torch.equal(trunk(values, torch.zeros(5, 2)), trunk(values))
    assert not torch.equal(trunk(values, torch.ones(5, 2)), trunk(values))
    assert [tuple(one.shape) for one in trunk.beside.parameters()] == [(8, 2), (8, 2)]


def test_glorot_weights_fill_their_range_and_biases_are_zero() -> None:
    trunk = Trunk(40, 60, 2, None)
    initialise(trunk, "glorot")
    first, bound = trunk.layers[0], math.sqrt(6 / 100)
    assert 0.98 * bound < first.weight.abs().max() <= bound
    assert not first.bias.any()


def test_a_frame_has_its_own_code_and_a_time_between_two_a_mixture() -> None:
    codes = TimeCodes((0.0, 0.5, 1.0), 2)
    table = codes.table.weight.detach()
    mixed = codes(torch.tensor([0.0, 0.5, 1.0, 0.6]))
    torch.testing.assert_close(mixed[:3], table)
    torch.testing.assert_close(mixed[3], 0.8 * table[1] + 0.2 * table[2])
    assert (table >= 0).all() and (table < 0.05).all()
    codes(torch.tensor([0.5])).sum().backward()  # and learns it alone
    assert codes.table.weight.grad is not None
    assert codes.table.weight.grad.tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]


def test_an_mlp_has_so_many_hidden_layers() -> None:
    layers = mlp(3, width=5, depth=2, outputs=4, bias=False)
    assert [tuple(p.shape) for p in layers.parameters()] == [(5, 3), (5, 5), (4, 5)]
    assert mlp(3, width=5, depth=1, outputs=4)[-1].bias.shape == (4,)

"""Trunks: where their inputs enter, and how they begin."""

from __future__ import annotations

import math

import torch

from devrf.methods.nerf.networks import Trunk, initialise


def test_the_input_enters_the_layer_that_was_asked_for() -> None:
    assert [layer.in_features for layer in Trunk(3, 8, 6, skip=5).layers] == [3, 8, 8, 8, 8, 11]
    assert [layer.in_features for layer in Trunk(3, 8, 6).layers] == [3, 8, 8, 11, 8, 8]
    assert [layer.in_features for layer in Trunk(3, 8, 2, skip=4).layers] == [3, 8]


def test_a_second_input_of_zeros_changes_nothing_and_its_weights_are_apart() -> None:
    trunk, values = Trunk(3, 8, 4, beside=2), torch.rand(5, 3)
    assert torch.equal(trunk(values, torch.zeros(5, 2)), trunk(values))
    assert not torch.equal(trunk(values, torch.ones(5, 2)), trunk(values))
    assert [tuple(one.shape) for one in trunk.beside_weights()] == [(8, 2), (8, 2)]


def test_glorot_weights_fill_their_range_and_biases_are_zero() -> None:
    trunk = Trunk(40, 60, 2)
    initialise(trunk, "glorot")
    first, bound = trunk.layers[0], math.sqrt(6 / 100)
    assert 0.98 * bound < first.weight.abs().max() <= bound
    assert not first.bias.any()

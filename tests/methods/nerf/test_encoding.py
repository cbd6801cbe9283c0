"""Sinusoidal encodings, by hand."""

from __future__ import annotations

import math

import torch

from devrf.methods.nerf.networks import SinusoidalEncoding, octave_window


def test_two_octaves_of_a_number() -> None:
    encode = SinusoidalEncoding(1, 2)
    x = 0.3
    expected = [x, math.sin(x), math.sin(2 * x), math.cos(x), math.cos(2 * x)]
    torch.testing.assert_close(encode(torch.tensor([[x]]))[0], torch.tensor(expected))
    assert encode.size == 5


def test_without_octaves_the_vector_is_its_own_encoding() -> None:
    points = torch.tensor([[0.1, -0.2, 0.3]])
    assert torch.equal(SinusoidalEncoding(3, 0)(points), points)


def test_a_window_opens_octaves_from_coarse_to_fine() -> None:
    window = octave_window(torch.tensor(1.5), 3)
    torch.testing.assert_close(window, torch.tensor([1.0, 0.5, 0.0]))
    assert octave_window(torch.tensor(0.0), 3).tolist() == [0.0, 0.0, 0.0]
    assert octave_window(torch.tensor(3.0), 3).tolist() == [1.0, 1.0, 1.0]


def test_a_shut_window_leaves_the_vector_alone_and_an_open_one_changes_nothing() -> None:
    encode, points = SinusoidalEncoding(3, 2), torch.rand(4, 3)
    shut, opened = encode(points, torch.zeros(2)), encode(points, torch.ones(2))
    assert torch.equal(shut[:, :3], points) and not shut[:, 3:].any()
    assert torch.equal(opened, encode(points))


def test_a_window_weighs_all_numbers_of_an_octave() -> None:
    x, y = 0.3, -0.8
    encoded = SinusoidalEncoding(2, 2, identity=False)(
        torch.tensor([[x, y]]), torch.tensor([1.0, 0.5])
    )
    sines = [math.sin(x), math.sin(y), 0.5 * math.sin(2 * x), 0.5 * math.sin(2 * y)]
    cosines = [math.cos(x), math.cos(y), 0.5 * math.cos(2 * x), 0.5 * math.cos(2 * y)]
    torch.testing.assert_close(encoded[0], torch.tensor(sines + cosines))

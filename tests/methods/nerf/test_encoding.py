"""Sinusoidal encodings, by hand."""

from __future__ import annotations

import math

import torch

from devrf.methods.nerf.encoding import SinusoidalEncoding


def test_two_octaves_of_a_number() -> None:
    encode = SinusoidalEncoding(1, 2)
    x = 0.3
    expected = [x, math.sin(x), math.sin(2 * x), math.cos(x), math.cos(2 * x)]
    torch.testing.assert_close(encode(torch.tensor([[x]]))[0], torch.tensor(expected))
    assert encode.size == 5


def test_without_octaves_the_vector_is_its_own_encoding() -> None:
    points = torch.tensor([[0.1, -0.2, 0.3]])
    assert torch.equal(SinusoidalEncoding(3, 0)(points), points)

"""Spherical harmonics are those of mathematics."""

from __future__ import annotations

import math

import torch
from scipy.special import sph_harm_y

from devrf.ops.spherical_harmonics import spherical_harmonics


def test_directions_are_spherical_harmonics() -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    x, y, z = directions.double().unbind(1)
    theta = z.acos().numpy()
    phi = torch.atan2(y, x).numpy()
    found = spherical_harmonics(directions)
    column = 0
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            real = value.imag if order < 0 else value.real
            scale = math.sqrt(2) if order else 1.0
            expected = torch.from_numpy(scale * real).float()
            torch.testing.assert_close(found[:, column], expected, atol=1e-5, rtol=0)
            column += 1

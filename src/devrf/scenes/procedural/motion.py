"""Building blocks of exact motion: rotations, and rotations that vary with a kept distance.

A rotation about a point by an angle that depends only on the distance from that point keeps
that distance; so it is undone exactly by the opposite angle at the same distance. It shears
space, and :func:`stretch` says by how much at most it lengthens anything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Swing:
    """A part of a sine that starts at 0: sin(rate · t + phase) − sin(phase).

    Attributes:
        rate: radians per unit of time.
        phase: radians; 0 starts at full speed, −1 starts slowly and is fast later.
    """

    rate: float
    phase: float

    def __call__(self, time: float) -> float:
        """The swing at ``time``."""
        return math.sin(self.rate * time + self.phase) - math.sin(self.phase)


def rotation(axis: tuple[float, float, float], angle: float) -> Tensor:
    """(3, 3) float64 right-handed rotation by ``angle`` (radians) about a unit ``axis``.

    Rodrigues' formula: R = I + sin(a) K + (1 − cos(a)) K², K the axis's cross-product matrix.
    """
    x, y, z = axis
    k = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def turn(a: Tensor, b: Tensor, angle: Tensor | float) -> tuple[Tensor, Tensor]:
    """Coordinates (a, b) turned in their plane by ``angle`` (radians), from a towards b."""
    angle = torch.as_tensor(angle, dtype=a.dtype, device=a.device)
    cos, sin = angle.cos(), angle.sin()
    return cos * a - sin * b, sin * a + cos * b


def smooth_ramp(value: Tensor, start: float, end: float) -> Tensor:
    """0 up to ``start``, 1 from ``end`` on, between them 3u² − 2u³."""
    u = ((value - start) / (end - start)).clamp(0, 1)
    return u * u * (3 - 2 * u)


def ramp_shear(start: float, end: float) -> float:
    """The largest ρ · d/dρ of ``smooth_ramp(ρ, start, end)``: the shear of a unit angle."""
    u = torch.linspace(0, 1, 1001, dtype=torch.float64)
    rho = start + (end - start) * u
    return float((rho * 6 * u * (1 - u) / (end - start)).max())


def stretch(shear: float) -> float:
    """The largest singular value of I + w nᵀ with w ⟂ n, |n| = 1, |w| = ``shear``.

    The inverse map has the same one, so a distance field seen through either is at most this
    much steeper.
    """
    return (shear + math.sqrt(shear * shear + 4)) / 2

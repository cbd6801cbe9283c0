"""Building blocks of exact motion: rotations, and rotations that vary with a kept distance.

A rotation about a point by an angle that depends only on the distance from that point keeps
that distance; so it is undone exactly by the opposite angle at the same distance. It shears
space; :func:`stretch` is the largest factor by which it lengthens anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Swing:
    """A part of a sine that starts at 0: amplitude · (sin(rate · t + phase) − sin(phase)).

    Attributes:
        amplitude: factor of the sine, in radians where the swing is an angle.
        rate: radians per unit of time.
        phase: radians; 0 starts at full speed, −1 starts slowly and is fast later.
    """

    amplitude: float
    rate: float
    phase: float

    def __call__(self, speed: float, time: float) -> float:
        """``speed`` times the swing at ``time``."""
        swing = math.sin(self.rate * time + self.phase) - math.sin(self.phase)
        return speed * self.amplitude * swing


def rotation(axis: tuple[float, float, float], angle: float) -> Tensor:
    """(3, 3) float64 right-handed rotation by ``angle`` (radians) about a unit ``axis``.

    Rodrigues' formula: R = I + sin(a) K + (1 − cos(a)) K², K the axis's cross-product matrix.
    """
    x, y, z = axis
    k = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def turn(a: Tensor, b: Tensor, angle: Tensor | float) -> tuple[Tensor, Tensor]:
    """Coordinates (a, b) turned in their plane by ``angle`` (radians), from a towards b."""
    if isinstance(angle, float) and angle == 0:
        return a, b
    angle = torch.as_tensor(angle, dtype=a.dtype, device=a.device)
    cos = angle.cos()
    sin = angle.sin()
    return cos * a - sin * b, sin * a + cos * b


def stretch(shear: float) -> float:
    """The largest singular value of I + w nᵀ with w ⟂ n, |n| = 1, |w| = ``shear``.

    The inverse map has the same one, so a distance field seen through either is at most this
    much steeper.
    """
    return (shear + math.sqrt(shear * shear + 4)) / 2


class Bending:
    """Turns about the origin by angles that build up with the distance ρ from it.

    The angle is 0 up to the ramp's start, the whole swing from its end on, and in between
    3u² − 2u³ of it.
    """

    def __init__(
        self, ramp: tuple[float, float], turns: tuple[tuple[int, int, Swing], ...]
    ) -> None:
        """Bend between the distances ``ramp`` (start and end, world units).

        Each of ``turns``, in the order in which they are made, is from one axis (0, 1, 2) towards
        another, with its angle in radians.
        """
        self._ramp = ramp
        self._turns = turns
        start, end = ramp
        u = torch.linspace(0, 1, 1001, dtype=torch.float64)
        rho = start + (end - start) * u
        # The largest ρ · d(angle)/dρ for an angle of 1.
        self._shear = float((rho * 6 * u * (1 - u) / (end - start)).max())

    def bent(self, points: Tensor, speed: float, time: float) -> Tensor:
        """Canonical points (M, 3) at ``time``."""
        return self._turned(points, [(a, b, swing(speed, time)) for a, b, swing in self._turns])

    def unbent(self, points: Tensor, speed: float, time: float) -> Tensor:
        """The exact inverse of :meth:`bent`."""
        back = reversed(self._turns)
        return self._turned(points, [(a, b, -swing(speed, time)) for a, b, swing in back])

    def stretch(self, speed: float, time: float) -> float:
        """The largest factor by which bending, or undoing it, lengthens anything."""
        angles = sum(abs(swing(speed, time)) for _, _, swing in self._turns)
        return stretch(angles * self._shear)

    def _turned(self, points: Tensor, turns: Iterable[tuple[int, int, float]]) -> Tensor:
        axes = list(points.unbind(-1))
        start, end = self._ramp
        u = ((length(points) - start) / (end - start)).clamp(0, 1)
        ramp = u * u * (3 - 2 * u)
        for a, b, angle in turns:
            axes[a], axes[b] = turn(axes[a], axes[b], angle * ramp)
        return torch.stack(axes, dim=-1)


def length(points: Tensor) -> Tensor:
    """Distance (M,) of points (M, 3) from the origin."""
    x, y, z = points.unbind(-1)
    return (x * x + y * y + z * z).sqrt()

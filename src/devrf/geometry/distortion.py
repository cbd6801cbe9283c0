"""Lens distortion: where a real lens puts what a pinhole would put elsewhere.

The radial-tangential model of Brown (1966), in the notation of OpenCV. Points are (x/z, y/z) of
a camera whose x points right and y down, before focal lengths and principal point. With
r² = x² + y² and g = 1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸,

    x' = g·x + 2·p1·x·y + p2·(r² + 2x²),    y' = g·y + p1·(r² + 2y²) + 2·p2·x·y.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Distortion:
    """The coefficients of one lens, without unit.

    Attributes:
        radial: k1, k2, k3, k4: OpenCV's first three, and a fourth term of the same series.
        tangential: p1, p2.
    """

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def none(self) -> bool:
        """Whether the lens is a pinhole."""
        return not any(self.radial) and not any(self.tangential)

    def distort(self, points: Tensor) -> Tensor:
        """Where the lens puts the pinhole's ``points`` (..., 2)."""
        x, y = points.unbind(-1)
        square, gain, _ = self._radial(x, y)
        p1, p2 = self.tangential
        cross = 2 * x * y
        return torch.stack(
            [
                gain * x + p1 * cross + p2 * (square + 2 * x * x),
                gain * y + p1 * (square + 2 * y * y) + p2 * cross,
            ],
            dim=-1,
        )

    def upright(self, points: Tensor) -> Tensor:
        """Mask (...,) of the pinhole's ``points`` (..., 2) that lie before the fold."""
        xx, xy, yy = self._jacobian(points)
        return (xx + yy > 0) & (xx * yy - xy * xy > 0)

    def _radial(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """r², the gain g, and dg/d(r²)."""
        k1, k2, k3, k4 = self.radial
        s = x * x + y * y
        gain = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
        return s, gain, k1 + s * (2 * k2 + s * (3 * k3 + s * 4 * k4))

    def _jacobian(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """dx'/dx, dx'/dy = dy'/dx, and dy'/dy."""
        x, y = points.unbind(-1)
        _, gain, slope = self._radial(x, y)
        p1, p2 = self.tangential
        return (
            gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
            gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )

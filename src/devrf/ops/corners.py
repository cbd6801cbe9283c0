"""Grids whose corners coincide with a box's corners: from positions to grid coordinates.

Numbers that depend only on the box are cached on the device: to make a tensor from Python numbers
at every step, the host would wait for the device.
"""

from __future__ import annotations

from functools import cache
from typing import Protocol

import torch
from torch import Tensor

Triple = tuple[float, float, float]
Shape = tuple[int, int, int]


class Corners(Protocol):
    """An axis-aligned box: anything that has a low and a high corner."""

    @property
    def low(self) -> Triple:
        """The corner (x, y, z) with the smallest coordinates."""

    @property
    def high(self) -> Triple:
        """The corner (x, y, z) with the largest coordinates."""


def to_grid(points: Tensor, box: Corners, shape: Shape) -> Tensor:
    """Grid coordinates (M, 3) of ``points`` (M, 3): 0 on the low faces, shape − 1 on the high.

    Differentiable in ``points``. Copies nothing from the host after the first call with the same
    box and shape.
    """
    low, scale = _on_device(box.low, box.high, shape, points.dtype, points.device)
    return (points - low) * scale


def shape_of(grid: Tensor) -> Shape:
    """Grid points along x, y, z of a grid (X, Y, Z) or (X, Y, Z, C)."""
    x, y, z = grid.shape[:3]
    return x, y, z


@cache
def _on_device(
    low: Triple, high: Triple, shape: Shape, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """The low corner, and the grid points per unit of length."""
    # A cached tensor made in inference mode could not be used for training later.
    with torch.inference_mode(False):
        corner, points = torch.tensor(low, dtype=dtype), torch.tensor(shape, dtype=dtype)
        scale = (points - 1) / (torch.tensor(high, dtype=dtype) - corner)
        return corner.to(device), scale.to(device)

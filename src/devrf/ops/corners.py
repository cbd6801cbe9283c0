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


def axes_of(box: Corners | None, grid: Tensor) -> Tensor:
    """What kernels know of a grid (X, Y, Z) or (X, Y, Z, C) that fills a box, float32 (9,).

    For x, y, z the low corner, then the grid points per unit of length, then their number. Without
    a box positions are in units of the grid.
    """
    x, y, z = shape_of(grid)
    if box is None:
        return _axes((0.0, 0.0, 0.0), (x - 1.0, y - 1.0, z - 1.0), (x, y, z), grid.device)
    return _axes(box.low, box.high, (x, y, z), grid.device)


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


@cache
def _axes(low: Triple, high: Triple, shape: Shape, device: torch.device) -> Tensor:
    corner, scale = _on_device(low, high, shape, torch.float32, torch.device("cpu"))
    with torch.inference_mode(False):
        return torch.cat([corner, scale, torch.tensor(shape, dtype=torch.float32)]).to(device)

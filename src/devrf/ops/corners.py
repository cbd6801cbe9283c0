"""Grids whose corners coincide with a box's corners: from positions to grid coordinates.

Numbers that depend only on the box are cached on the device: to make a tensor from Python numbers
at every step, the host would wait for the device.
"""

from __future__ import annotations

from functools import lru_cache
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


@lru_cache(maxsize=256)
def _scale(low: Triple, high: Triple, shape: Shape, dtype: torch.dtype) -> Tensor:
    # A cached tensor made in inference mode could not be used for training later.
    with torch.inference_mode(False):
        extent = torch.tensor(shape, dtype=dtype) - 1
        return extent / (torch.tensor(high, dtype=dtype) - torch.tensor(low, dtype=dtype))


@lru_cache(maxsize=256)
def _on_device(
    low: Triple, high: Triple, shape: Shape, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False):
        corner = torch.tensor(low, dtype=dtype).to(device)
        return corner, _scale(low, high, shape, dtype).to(device)


@lru_cache(maxsize=256)
def _axes(low: Triple, high: Triple, shape: Shape, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        corner, points = torch.tensor(low), torch.tensor(shape, dtype=torch.float32)
        return torch.cat([corner, _scale(low, high, shape, torch.float32), points]).to(device)

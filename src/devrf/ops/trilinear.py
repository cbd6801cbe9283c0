"""Trilinear interpolation of a grid whose outer points lie on a box, channels last."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from devrf.geometry.box import Box

Shape = tuple[int, int, int]


def interpolate(grid: Tensor, points: Tensor, box: Box, stride: int = 1) -> Tensor:
    """Values of a grid between its points; outside the box they are those of the border.

    ``Σ_{i,j,k ∈ {0,1}} w_i(x) w_j(y) w_k(z) · grid[⌊(x, y, z)⌋ + (i, j, k)]`` with linear weights.

    Args:
        grid: (X, Y, Z, C), at least two points along x and y; one along z is a plane, the same for
            all z.
        points: (M, 3) in the box's units.
        box: the grid's outer points lie on it.
        stride: use every stride-th of the grid's points along each axis; X, Y, Z are one more than
            a multiple of it.

    Returns:
        (M, C), differentiable in ``grid`` and ``points``.
    """
    grid = grid[::stride, ::stride, ::stride]
    shape = shape_of(grid)
    last = torch.tensor(shape, device=points.device) - 1
    at = box.to_grid(points, shape)
    at = torch.minimum(at.clamp(min=0), last.to(at.dtype))
    cell = at.detach().long().minimum(last - 1).clamp(min=0)
    fraction = at - cell
    values = grid.new_zeros(len(points), grid.shape[-1])
    for corner in product((0, 1), repeat=3):
        upper = torch.tensor(corner, device=points.device, dtype=torch.bool)
        weight = torch.where(upper, fraction, 1 - fraction).prod(dim=1)
        x, y, z = (cell + upper).minimum(last).unbind(1)
        values = values + weight[:, None] * grid[x, y, z]
    return values


def resample(values: Tensor, shape: Shape) -> Tensor:
    """A grid (X, Y, Z, C) at another resolution ``shape``, trilinear, corners kept in place."""
    if shape_of(values) == tuple(shape):
        return values.detach().clone()
    channels_first = values.permute(3, 0, 1, 2)[None]
    resized = torch.nn.functional.interpolate(
        channels_first, size=shape, mode="trilinear", align_corners=True
    )
    # Not contiguous(): of a single channel it keeps a stray stride, and interpolation becomes slow.
    return resized[0].permute(1, 2, 3, 0).clone(memory_format=torch.contiguous_format)


def shape_of(grid: Tensor) -> Shape:
    """Grid points along x, y, z of a grid (X, Y, Z) or (X, Y, Z, C)."""
    x, y, z = grid.shape[:3]
    return x, y, z

"""A dense voxel grid over a box: v(x) and f(x) of docs/method.md#notation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box
from devrf.ops.corners import shape_of, to_grid
from devrf.ops.trilinear import interpolate, kept_gradient, resample


def look_up(grid: Tensor, points: Tensor, box: Box) -> Tensor:
    """Trilinear values (M, C) of a ``grid`` (X, Y, Z, C) over ``box`` at ``points`` (M, 3).

    Outside they are the border's. Differentiable in the grid and the points; a gradient that the
    grid has already is added to in place.
    """
    coords = to_grid(points, box, shape_of(grid))
    return interpolate(grid, coords, gradient=kept_gradient(grid))


class VoxelGrid(StoredShape):
    """Values at the points of a grid whose outer points lie on a box.

    Attributes:
        values: (X, Y, Z, C), channels last so that a grid point is one row of memory.
    """

    resizable = ("values",)  # a run may have ended at any resolution
    values: nn.Parameter

    def __init__(self, shape: tuple[int, int, int], channels: int, fill: float = 0.0) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.full((*shape, channels), fill))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        x, y, z, _ = self.values.shape
        return x, y, z

    def forward(self, points: Tensor, box: Box) -> Tensor:
        """Trilinear values (M, C) at ``points`` (M, 3) in ``box``; outside, the border's."""
        return look_up(self.values, points, box)

    @torch.no_grad()
    def resize(self, shape: tuple[int, int, int]) -> None:
        """Resample to another grid over the same box, trilinearly; a new parameter results."""
        self.values = nn.Parameter(resample(self.values, shape))

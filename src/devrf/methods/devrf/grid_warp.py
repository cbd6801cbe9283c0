"""The warp of points by displacement grids (docs/method.md#quadruple-interpolation)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops.corners import shape_of, to_grid
from devrf.ops.trilinear import interpolate, kept_gradient


@dataclass(frozen=True)
class GridWarp:
    """x → x + Δ(x, t), Δ = (1 − λ) Δ_k + λ Δ_{k+1}, each Δ_k trilinear in space.

    Attributes:
        slices: Δ_k (X, Y, Z, 3) in the box's units: one frame's, or those of the two frames
            between which t lies; none is the identity.
        box: where the grids live.
        weight: λ in [0, 1].
        still_outside: whether Δ is 0 outside the box; else it is as on the border.
    """

    slices: tuple[Tensor, ...]
    box: Box
    weight: float = 0.0
    still_outside: bool = False

    def __call__(self, points: Tensor) -> Tensor:
        """The points (M, 3) moved, (M, 3); differentiable in the slices and the points."""
        if not self.slices:
            return points
        coords = to_grid(points, self.box, shape_of(self.slices[0]))
        moves = [interpolate(frame, coords, gradient=kept_gradient(frame)) for frame in self.slices]
        move = moves[0] if len(moves) == 1 else moves[0].lerp(moves[1], self.weight)
        if self.still_outside:
            move = torch.where(self.box.contains(points)[:, None], move, 0.0)
        return points + move

"""A warp made of grids: points at one time to canonical space, or back."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops.corners import shape_of, to_grid
from devrf.ops.trilinear import interpolate, kept_gradient


@dataclass(frozen=True)
class GridWarp:
    """x → x + Δ(x); Δ is trilinear in each of its grids, and linear between two of them.

    Code that only moves points takes any function of points as a warp; the kernels that look up
    displacement and density in one pass need the slices.

    Attributes:
        slices: displacements (X, Y, Z, 3) in the box's units: one frame's, or those of the two
            frames between which a time lies; none leaves every point where it is.
        box: where the grids live; beyond it they go on as on its border.
        weight: share of the second of two frames, in [0, 1].
    """

    slices: tuple[Tensor, ...]
    box: Box
    weight: float = 0.0

    def __call__(self, points: Tensor) -> Tensor:
        """The points (M, 3) moved, (M, 3); differentiable in the slices and the points."""
        if not self.slices:
            return points
        coords = to_grid(points, self.box, shape_of(self.slices[0]))
        moves = [interpolate(frame, coords, gradient=kept_gradient(frame)) for frame in self.slices]
        return points + (moves[0] if len(moves) == 1 else moves[0].lerp(moves[1], self.weight))

"""The 4D deformation field V_motion, and its warps (docs/method.md#deformation-field)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.frame_store import FrameField, FrameStore
from devrf.ops.trilinear import Shape
from devrf.system.plain_data import validate

# Far away, in longest edges of a box.
FAR = 1000.0
# Points (M, 3) → moved points (M, 3).
Warp = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class GridWarp:
    """x → x + Δ(x), Δ trilinear in space.

    Attributes:
        displacement: Δ (X, Y, Z, 3) in the box's units; None is the identity.
        box: of the grid.
        zero_outside_box: whether Δ is 0 outside the box; else it is as on the border.
    """

    displacement: Tensor | None
    box: Box
    zero_outside_box: bool = False

    def __call__(self, points: Tensor) -> Tensor:
        """The points (M, 3) moved, (M, 3); differentiable in the displacement and the points."""
        if self.displacement is None:
            return points
        move = interpolate(self.displacement, points, self.box)
        if self.zero_outside_box:
            move = torch.where(self.box.contains(points)[:, None], move, 0.0)
        return points + move

    def of_grid(self, box: Box, shape: Shape, device: torch.device) -> Tensor:
        """The points of a grid of ``shape`` over ``box``, moved: (M, 3), as columns in memory.

        It equals the warp of these points, and is faster: between two grids along the same axes
        interpolation is a matrix for each axis. Displacements that are no numbers lead far away.
        """
        lines = box.grid_lines(shape, torch.empty(0, device=device))
        points = torch.stack(torch.meshgrid(*lines, indexing="ij"))
        moves = self.displacement
        if moves is not None:
            # Products of matrices would spread NaN to all points.
            far = FAR * self.box.longest
            moves = moves.nan_to_num(nan=far, posinf=far, neginf=far).permute(3, 0, 1, 2)
            for axis, line in enumerate(lines):
                # An axis of the displacements goes, one of the points comes last.
                weights = self._weights(axis, line, moves.shape[1])
                moves = torch.tensordot(moves, weights, dims=([1], [1]))
            points += moves
        return points.view(3, -1).t()

    def _weights(self, axis: int, line: Tensor, points: int) -> Tensor:
        """Weights (N, points) of values at ``points`` along a box's axis, at coordinates (N,)."""
        low = self.box.low[axis]
        high = self.box.high[axis]
        coordinate = (line.clamp(low, high) - low) * ((points - 1) / (high - low))
        away = (coordinate[:, None] - torch.arange(points, device=line.device)).abs()
        weights = (1 - away).clamp(min=0)
        if self.zero_outside_box:
            weights *= ((line >= low) & (line <= high))[:, None]
        return weights


class DeformationField(FrameField):
    """Displacements (T, X, Y, Z, 3) over a box, backward and forward (docs/method.md#warp).

    Attributes:
        frames: the displacements of all frames, in the box's units.
        zero_outside_box: whether nothing moves outside the box, which is then smaller than the
            canonical field's; else displacements are as on the border there.
    """

    def __init__(
        self,
        box: Box,
        clock: FrameClock,
        voxels: int,
        planes: int | None = None,
        *,
        zero_outside_box: bool = False,
    ) -> None:
        """Zero displacements of T frames on grids of :meth:`~devrf.geometry.box.Box.grid_shape`."""
        super().__init__(box, clock)
        self.zero_outside_box = zero_outside_box
        self.frames = FrameStore(len(clock), box.grid_shape(voxels, planes))

    @property
    def backward_slices(self) -> Tensor:
        """(T, X, Y, Z, 3) Δ_b of every frame."""
        return self.frames.backward_slices

    @property
    def forward_slices(self) -> Tensor:
        """(T, X, Y, Z, 3) Δ_f of every frame."""
        return self.frames.forward_slices

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        return self.frames.shape

    def backward_warp(self, time: float) -> GridWarp:
        """x → q = x + Δ_b(x, t): points at ``time`` t → canonical points."""
        return self._at(self.backward_slices, time)

    def forward_warp(self, time: float) -> GridWarp:
        """q → q + Δ_f(q, t): canonical points → where they are at ``time`` t."""
        return self._at(self.forward_slices, time)

    def warp_by(self, displacement: Tensor | None) -> GridWarp:
        """The warp by a grid (X, Y, Z, 3) over the field's box; by none, the identity."""
        return GridWarp(displacement, self.box, self.zero_outside_box)

    def _at(self, frames: Tensor, time: float) -> GridWarp:
        """By Δ = (1 − λ) Δ_k + λ Δ_{k+1}, t lying between frames k and k + 1; at rest by none."""
        moment, here = self.clock.at(time), self.frames.here
        if moment.after == 0:
            return self.warp_by(None)
        displacement = frames[moment.before].to(here)
        if moment.weight:
            displacement = displacement.lerp(frames[moment.after].to(here), moment.weight)
        return self.warp_by(displacement)

    @torch.no_grad()
    def resize(self, voxels: int, planes: int | None = None) -> None:
        """Resample every frame to about ``voxels`` voxels, in ``planes`` if given, trilinearly."""
        self.frames.resize(self.box.grid_shape(voxels, planes))

    def get_extra_state(self) -> dict[str, Any]:
        """Box, clock and ``zero_outside_box``, as plain data."""
        return {**super().get_extra_state(), "zero_outside_box": self.zero_outside_box}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`get_extra_state`."""
        super().set_extra_state(state)
        self.zero_outside_box = validate(bool, state["zero_outside_box"])

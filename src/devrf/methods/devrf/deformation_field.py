"""The 4D deformation field: where each point of each frame lies in canonical space, and back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from devrf.engine.frame_store import FrameStore
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.grid_warp import GridWarp


class DeformationField(nn.Module):
    """Displacements (T, X, Y, Z, 3) over a box, backward and forward (docs/method.md#warp).

    A point x at time t is seen in canonical space at x + Δ_b(x, t); a canonical point q is at
    q + Δ_f(q, t) at time t. Between frames both are blended linearly, which with the trilinear
    interpolation in space makes the quadruple interpolation. Frame 0 is zero and is never
    trained: at t = 0 the warp is the identity, exactly.

    Attributes:
        frames: the displacements of all frames, in the box's units.
        box: where the field lives.
        clock: the times of the T frames.
    """

    def __init__(self, box: Box, clock: FrameClock, *, voxels: int) -> None:
        """A field at rest: no displacement anywhere.

        Args:
            box: where the field lives.
            clock: the frames' times; frame 0 is the rest state.
            voxels: about how many voxels each frame has.
        """
        super().__init__()
        self.box = box
        self.clock = clock
        self.frames = FrameStore(len(clock), box.grid_shape(voxels))

    @property
    def to_canonical(self) -> Tensor:
        """(T, X, Y, Z, 3) Δ_b of every frame."""
        return self.frames.to_canonical

    @property
    def to_time(self) -> Tensor:
        """(T, X, Y, Z, 3) Δ_f of every frame."""
        return self.frames.to_time

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        _, x, y, z, _ = self.to_canonical.shape
        return x, y, z

    def warp(self, points: Tensor, time: float) -> Tensor:
        """Canonical positions (M, 3) of ``points`` (M, 3) at ``time``; the identity at 0."""
        return self.warp_at(time)(points)

    def unwarp(self, points: Tensor, time: float) -> Tensor:
        """Positions (M, 3) at ``time`` of canonical ``points`` (M, 3); the identity at 0."""
        return self.unwarp_at(time)(points)

    def warp_at(self, time: float) -> GridWarp:
        """The map of points at ``time`` into canonical space."""
        return self._at(self.to_canonical, time)

    def unwarp_at(self, time: float) -> GridWarp:
        """The map of canonical points to where they are at ``time``."""
        return self._at(self.to_time, time)

    def _at(self, frames: Tensor, time: float) -> GridWarp:
        moment = self.clock.at(time)
        chosen = (moment.before,) if moment.weight == 0.0 else (moment.before, moment.after)
        here = self.frames.here
        slices = tuple(frames[k].to(here) for k in chosen if len(chosen) > 1 or k)
        return GridWarp(slices, self.box, moment.weight)

    def blended(self, time: float) -> Tensor:
        """Δ_b at ``time`` as one grid (X, Y, Z, 3).

        On a frame it is the frame's own memory, if that is where the field works, in single
        precision. Looking a point up there takes one trilinear interpolation instead of two, and a
        rounding of its own.
        """
        moment, here = self.clock.at(time), self.frames.here
        before = self.to_canonical[moment.before].to(here)
        if not moment.weight:
            return before
        return before.lerp(self.to_canonical[moment.after].to(here), moment.weight)

    @torch.no_grad()
    def resize(self, voxels: int) -> None:
        """Resample every frame to about ``voxels`` voxels, trilinearly."""
        self.frames.resize(self.box.grid_shape(voxels))

    def get_extra_state(self) -> dict[str, Any]:
        """Box and clock, as plain numbers."""
        return {
            "low": list(self.box.low),
            "high": list(self.box.high),
            "times": list(self.clock.times),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave."""
        self.box = Box.of(state["low"], state["high"])
        self.clock = FrameClock(tuple(state["times"]))

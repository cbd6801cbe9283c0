"""The 4D deformation field V_motion (docs/method.md#deformation-field)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devrf.engine.frame_store import FrameStore
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.frame_field import FrameField
from devrf.methods.devrf.grid_warp import GridWarp


class DeformationField(FrameField):
    """Displacements (T, X, Y, Z, 3) over a box, backward and forward (docs/method.md#warp).

    A point x at time t is seen in canonical space at q = x + Δ_b(x, t); a canonical point q is at
    q + Δ_f(q, t) at time t. Frame 0 is zero and never trained: at t = 0 the warp is exactly the
    identity.

    Attributes:
        frames: the displacements of all frames, in the box's units.
        box: where the field lives.
        clock: the times of the T frames.
        still_outside: whether nothing moves outside the box, which is then smaller than the
            canonical field's; else displacements are as on the border there.
    """

    def __init__(
        self, box: Box, clock: FrameClock, *, voxels: int, still_outside: bool = False
    ) -> None:
        """Zero displacements of the clock's T frames, each on about ``voxels`` voxels."""
        super().__init__(box, clock)
        self.still_outside = still_outside
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
        """x + Δ_b(x, t) (M, 3) of ``points`` x (M, 3) at ``time`` t."""
        return self.warp_at(time)(points)

    def unwarp(self, points: Tensor, time: float) -> Tensor:
        """q + Δ_f(q, t) (M, 3) of canonical ``points`` q (M, 3) at ``time`` t."""
        return self._at(self.to_time, time)(points)

    def warp_at(self, time: float) -> GridWarp:
        """The map x → x + Δ_b(x, t) at ``time`` t."""
        return self._at(self.to_canonical, time)

    def _at(self, frames: Tensor, time: float) -> GridWarp:
        moment = self.clock.at(time)
        chosen = (moment.before,) if moment.weight == 0.0 else (moment.before, moment.after)
        here = self.frames.here
        slices = tuple(frames[k].to(here) for k in chosen if len(chosen) > 1 or k)
        return GridWarp(slices, self.box, moment.weight, self.still_outside)

    def blended(self, time: float) -> Tensor:
        """Δ_b at ``time`` as one grid (X, Y, Z, 3): one look-up a point instead of two.

        Rounded differently than :meth:`warp`. On a frame it shares the frame's memory, if the
        frames are kept in single precision on the device.
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
        """Box and clock, as plain numbers, and whether nothing moves outside."""
        outside = {"still_outside": True} if self.still_outside else {}
        return super().get_extra_state() | outside

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave."""
        super().set_extra_state(state)
        self.still_outside = bool(state.get("still_outside"))

"""The 4D deformation field: where each point of each frame lies in canonical space, and back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from devrf.fields.grid import resample
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.ops.trilinear import interpolate


class DeformationField(nn.Module):
    """Displacements (T, X, Y, Z, 3) over a box, backward and forward (method §3).

    A point x at time t is seen in canonical space at x + Δ_b(x, t); a canonical point q is at
    q + Δ_f(q, t) at time t. Between frames both are blended linearly, which with the trilinear
    interpolation in space makes the quadruple interpolation. Frame 0 is zero and is never
    trained: at t = 0 the warp is the identity, exactly.

    Attributes:
        to_canonical: (T, X, Y, Z, 3) Δ_b in the box's units.
        to_time: (T, X, Y, Z, 3) Δ_f in the box's units.
        box: where the field lives.
        clock: the times of the T frames.
    """

    to_canonical: Tensor
    to_time: Tensor

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
        shape = (len(clock), *box.grid_shape(voxels), 3)
        self.register_buffer("to_canonical", torch.zeros(shape))
        self.register_buffer("to_time", torch.zeros(shape))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        _, x, y, z, _ = self.to_canonical.shape
        return x, y, z

    def warp(self, points: Tensor, time: float) -> Tensor:
        """Canonical positions (M, 3) of ``points`` (M, 3) at ``time``; the identity at 0."""
        return points + self.displacement(self.to_canonical, points, time)

    def unwarp(self, points: Tensor, time: float) -> Tensor:
        """Positions (M, 3) at ``time`` of canonical ``points`` (M, 3); the identity at 0."""
        return points + self.displacement(self.to_time, points, time)

    def displacement(self, frames: Tensor, points: Tensor, time: float) -> Tensor:
        """4-linear interpolation (M, 3) of ``frames`` (T, X, Y, Z, 3) at ``points``, ``time``."""
        moment = self.clock.at(time)
        coords = self.box.to_grid(points, self.shape)
        value = interpolate(frames[moment.before], coords)
        if moment.weight == 0.0:
            return value
        return value.lerp(interpolate(frames[moment.after], coords), moment.weight)

    def blended(self, frames: Tensor, time: float) -> Tensor:
        """The one grid (X, Y, Z, 3) that says at ``time`` what ``frames`` (T, X, Y, Z, 3) say.

        On a frame it is the frame's own memory. Looking a point up there takes one trilinear
        interpolation instead of two, and a rounding of its own.
        """
        moment = self.clock.at(time)
        before = frames[moment.before]
        return before.lerp(frames[moment.after], moment.weight) if moment.weight else before

    def slice(self, frame: int) -> tuple[Tensor, Tensor]:
        """Leaves that share the memory of one frame, for an optimiser to step on in place.

        Args:
            frame: 1 … T − 1; frame 0 cannot be trained.

        Returns:
            backward and forward displacements (X, Y, Z, 3), requiring gradients.
        """
        if not 1 <= frame < len(self.clock):
            raise IndexError(f"frame {frame} cannot be trained: only 1 to {len(self.clock) - 1}")
        leaves = (self.to_canonical[frame].detach(), self.to_time[frame].detach())
        return leaves[0].requires_grad_(), leaves[1].requires_grad_()

    @torch.no_grad()
    def carry(self, frame: int) -> None:
        """Start ``frame`` from the frame before it, in both directions."""
        self.to_canonical[frame] = self.to_canonical[frame - 1]
        self.to_time[frame] = self.to_time[frame - 1]

    @torch.no_grad()
    def resize(self, voxels: int) -> None:
        """Resample every frame to about ``voxels`` voxels, trilinearly."""
        shape = self.box.grid_shape(voxels)
        self.to_canonical = _resampled(self.to_canonical, shape)
        self.to_time = _resampled(self.to_time, shape)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for name in ("to_canonical", "to_time"):
            stored = state_dict.get(prefix + name)
            if stored is not None and stored.shape != getattr(self, name).shape:
                setattr(self, name, getattr(self, name).new_empty(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

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


def _resampled(frames: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Frames (T, X, Y, Z, 3) at another resolution, each written to its place: no copy of all."""
    resized = frames.new_empty(len(frames), *shape, 3)
    for into, frame in zip(resized, frames, strict=True):
        into.copy_(resample(frame, shape))
    return resized

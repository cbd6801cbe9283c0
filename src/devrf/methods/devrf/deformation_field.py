"""The 4D deformation field: where each point of each frame lies in canonical space, and back."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.voxel_grid import resample

log = logging.getLogger(__name__)

Directions = tuple[Tensor, Tensor]


class DeformationField(nn.Module):
    """Displacements (T, X, Y, Z, 3) over a box, backward and forward (method §3).

    A point x at time t is seen in canonical space at x + Δ_b(x, t); a canonical point q is at
    q + Δ_f(q, t) at time t. Between frames both are blended linearly, which with the trilinear
    interpolation in space makes the quadruple interpolation. Frame 0 is zero and is never
    trained: at t = 0 the warp is the identity, exactly.

    All frames together are large, and few are needed at a time: they may rest on the host, or in
    half precision (:meth:`rest`). Whatever is taken out of the field is in single precision and on
    the device that the module is on.

    Attributes:
        to_canonical: (T, X, Y, Z, 3) Δ_b in the box's units.
        to_time: (T, X, Y, Z, 3) Δ_f in the box's units.
        box: where the field lives.
        clock: the times of the T frames.
        on_host: whether the displacements stay on the host wherever the module goes.
    """

    to_canonical: Tensor
    to_time: Tensor
    here: Tensor

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
        self.on_host = False
        shape = (len(clock), *box.grid_shape(voxels), 3)
        self.register_buffer("to_canonical", torch.zeros(shape))
        self.register_buffer("to_time", torch.zeros(shape))
        # It goes where the module goes, and so tells where that is.
        self.register_buffer("here", torch.zeros(0), persistent=False)
        self._coming: dict[int, tuple[Directions, torch.cuda.Stream]] = {}

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
        slices = tuple(frames[k].to(self.here) for k in chosen if len(chosen) > 1 or k)
        return GridWarp(slices, self.box, moment.weight)

    def blended(self, frames: Tensor, time: float) -> Tensor:
        """The one grid (X, Y, Z, 3) that says at ``time`` what ``frames`` (T, X, Y, Z, 3) say.

        On a frame it is the frame's own memory, if that is where the field works, in single
        precision. Looking a point up there takes one trilinear interpolation instead of two, and a
        rounding of its own.
        """
        moment = self.clock.at(time)
        before = frames[moment.before].to(self.here)
        if not moment.weight:
            return before
        return before.lerp(frames[moment.after].to(self.here), moment.weight)

    def slice(self, frame: int) -> Directions:
        """Leaves that share the memory of one frame, for an optimiser to step on in place.

        Args:
            frame: 1 … T − 1; frame 0 cannot be trained.

        Returns:
            backward and forward displacements (X, Y, Z, 3), requiring gradients.
        """
        self._check(frame)
        leaves = (self.to_canonical[frame].detach(), self.to_time[frame].detach())
        return leaves[0].requires_grad_(), leaves[1].requires_grad_()

    def _check(self, frame: int) -> None:
        if not 1 <= frame < len(self.clock):
            raise IndexError(f"frame {frame} cannot be trained: only 1 to {len(self.clock) - 1}")

    @torch.no_grad()
    def read(self, frame: int, into: Directions) -> None:
        """Copy a frame out of the field, without waiting for the device.

        Args:
            frame: which.
            into: backward and forward displacements (X, Y, Z, 3), overwritten.
        """
        source = (self.to_canonical[frame], self.to_time[frame])
        if frame in self._coming:
            source, side = self._coming.pop(frame)
            present = torch.cuda.current_stream(self.here.device)
            present.wait_stream(side)
            for tensor in source:
                tensor.record_stream(present)
        for tensor, value in zip(into, source, strict=True):
            tensor.copy_(value, non_blocking=True)

    @torch.no_grad()
    def read_forward(self, frame: int, into: Tensor) -> None:
        """As :meth:`read`, of the forward displacements alone."""
        into.copy_(self.to_time[frame], non_blocking=True)

    @torch.no_grad()
    def write(self, frame: int, displacements: Directions) -> None:
        """Copy a frame back: backward and forward ``displacements`` (X, Y, Z, 3).

        A device that is not the frames' own need not have come to it when this returns:
        :meth:`settle` before the host looks at them.
        """
        self._check(frame)
        for frames, value in zip((self.to_canonical, self.to_time), displacements, strict=True):
            frames[frame].copy_(value, non_blocking=True)
        self._coming.pop(frame, None)  # what is on its way is of before

    def settle(self) -> None:
        """Wait until the host sees everything that was written."""
        if self.on_host and self.here.is_cuda:
            torch.cuda.current_stream(self.here.device).synchronize()

    @torch.no_grad()
    def expect(self, frames: Sequence[int]) -> None:
        """Begin to fetch frames from the host, beside other work: they are read next."""
        if not (self.on_host and self.here.is_cuda):
            return
        device, self._coming = self.here.device, {}
        side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        # What was written to the frames has to be there first.
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(side):
            for frame in frames:
                backward = self.to_canonical[frame].to(device, non_blocking=True)
                forward = self.to_time[frame].to(device, non_blocking=True)
                self._coming[frame] = ((backward, forward), side)

    @torch.no_grad()
    def carry(self, frame: int) -> None:
        """Start ``frame`` from the frame before it, in both directions."""
        self.settle()
        self.to_canonical[frame] = self.to_canonical[frame - 1]
        self.to_time[frame] = self.to_time[frame - 1]

    @torch.no_grad()
    def resize(self, voxels: int) -> None:
        """Resample every frame to about ``voxels`` voxels, trilinearly."""
        shape, self._coming = self.box.grid_shape(voxels), {}
        for name in ("to_canonical", "to_time"):
            frames = getattr(self, name)
            resized = self._room((len(frames), *shape, 3), frames.dtype)
            # Each written to its place: no copy of all.
            for into, frame in zip(resized, frames, strict=True):
                into.copy_(resample(frame.to(self.here), shape), non_blocking=True)
            self.settle()
            setattr(self, name, resized)

    @torch.no_grad()
    def rest(self, *, on_host: bool, half: bool) -> None:
        """Say where the displacements rest, and how.

        Args:
            on_host: keep them on the host, in memory that a CUDA device reaches beside its work.
            half: keep them in half precision: to 1/2048 of each value.
        """
        self.on_host = on_host
        for name in ("to_canonical", "to_time"):
            frames = getattr(self, name)
            moved = self._room(frames.shape, torch.float16 if half else torch.float32)
            setattr(self, name, moved.copy_(frames))

    def _room(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """An uninitialised tensor where displacements rest."""
        if not self.on_host:
            return torch.empty(shape, dtype=dtype, device=self.here.device)
        if torch.cuda.is_available():
            try:
                return torch.empty(shape, dtype=dtype, pin_memory=True)
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
                log.warning("displacements are fetched slowly: no page-locked memory (%s)", reason)
        return torch.empty(shape, dtype=dtype)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> DeformationField:
        kept = ("to_canonical", "to_time") if self.on_host else ()
        frames = {name: self._buffers.pop(name) for name in kept}
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._buffers.update(frames)
        return self

    def __getstate__(self) -> dict[str, Any]:
        """What a copy takes over: not what is on its way."""
        return {**self.__dict__, "_coming": {}}

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        self._coming = {}
        for name in ("to_canonical", "to_time"):
            stored, frames = state_dict.get(prefix + name), getattr(self, name)
            if stored is not None and stored.shape != frames.shape:
                setattr(self, name, self._room(stored.shape, frames.dtype))
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

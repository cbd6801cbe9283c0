"""Fields of all frames, and the memory of their displacements while a few of them are learned.

All frames together are large (50 × 160³ × 3 single-precision values are 2.5 GB per direction), and
few are needed at a time: they may be kept on the host, or in half precision. Frames are always
read in single precision, on the module's device.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_grids import StoredShape
from devrf.engine.ddp import world_size
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.ops.trilinear import resample, shape_of
from devrf.system.plain_data import validate

log = logging.getLogger(__name__)

Directions = tuple[Tensor, Tensor]
Shape = tuple[int, int, int]
NAMES = ("backward_slices", "forward_slices")

# A displacement: three float32.
DISPLACEMENT = 12
# Grids of an active frame: both directions and the forward one of the frame before (3),
# gradients (2), Adam moments (4), and the copy that a rollback returns to (2).
ACTIVE_GRIDS = 11
# The share of a GPU's free memory that frames may take. The rest is for images, the canonical
# field and batches.
FRAMES_SHARE = 0.75


class FrameField(nn.Module):
    """A field of T grids, one for each frame, with its box and times; kept in checkpoints.

    Attributes:
        box: of the field.
        clock: the times of the T frames.
        values: (T, X, Y, Z, C) of a field that keeps all its frames in one tensor.
    """

    values: Tensor

    def __init__(self, box: Box, clock: FrameClock) -> None:
        super().__init__()
        self.box = box
        self.clock = clock

    def get_extra_state(self) -> dict[str, Any]:
        """Box and clock, as plain numbers."""
        return {
            "low": list(self.box.low),
            "high": list(self.box.high),
            "times": list(self.clock.times),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`get_extra_state`."""
        self.box = validate(Box, state)
        self.clock = validate(FrameClock, state)


class FrameStore(StoredShape):
    """Displacements of T frames in two directions.

    Attributes:
        backward_slices: (T, X, Y, Z, 3) Δ_b: from points at each frame's time to canonical ones.
        forward_slices: (T, X, Y, Z, 3) Δ_f: from canonical points to those at each frame's time.
        on_host: whether they stay on the host when the module is moved.
    """

    resizable: ClassVar = dict.fromkeys(NAMES, 4)
    backward_slices: Tensor
    forward_slices: Tensor
    here: Tensor

    def __init__(self, frames: int, shape: Shape) -> None:
        """Zero displacements of ``frames`` frames on grids of ``shape`` (X, Y, Z)."""
        super().__init__()
        self.on_host = False
        for name in NAMES:
            self.register_buffer(name, torch.zeros(frames, *shape, 3))
        # An empty tensor that is moved with the module: its device is the module's.
        self.register_buffer("here", torch.zeros(0), persistent=False)

    @property
    def shape(self) -> Shape:
        """Grid points along x, y, z."""
        return shape_of(self.backward_slices[0])

    @torch.no_grad()
    def read(self, frame: int, into: Directions) -> None:
        """Copy a frame's backward and forward displacements ``into`` (X, Y, Z, 3) each."""
        into[0].copy_(self.backward_slices[frame])
        into[1].copy_(self.forward_slices[frame])

    @torch.no_grad()
    def write(self, frame: int, displacements: Directions) -> None:
        """Copy backward and forward ``displacements`` (X, Y, Z, 3) back into a frame.

        Frame 0 is the rest state, and cannot be written.
        """
        assert 1 <= frame < len(self.forward_slices), f"frame {frame} cannot be trained"
        self.backward_slices[frame].copy_(displacements[0])
        self.forward_slices[frame].copy_(displacements[1])

    @torch.no_grad()
    def copy_previous(self, frame: int) -> None:
        """Initialise ``frame`` from the frame before it, in both directions."""
        self.backward_slices[frame] = self.backward_slices[frame - 1]
        self.forward_slices[frame] = self.forward_slices[frame - 1]

    @torch.no_grad()
    def resize(self, shape: Shape) -> None:
        """Resample every frame to grids of ``shape``, trilinearly."""
        for name in NAMES:
            frames = getattr(self, name)
            resized = self._empty((len(frames), *shape, 3), frames.dtype)
            # Frame by frame: no temporary copy of all of them.
            for into, frame in zip(resized, frames, strict=True):
                into.copy_(resample(frame.to(self.here), shape))
            setattr(self, name, resized)

    @torch.no_grad()
    def offload(self, *, on_host: bool, half: bool) -> None:
        """Keep them on the host, or in half precision."""
        self.on_host = on_host
        for name in NAMES:
            frames = getattr(self, name)
            moved = self._empty(frames.shape, torch.float16 if half else torch.float32)
            setattr(self, name, moved.copy_(frames))

    def take(self, backward: Tensor, forward: Tensor) -> None:
        """Hold these (T, X, Y, Z, 3) where they are; on the host they stay there.

        Raises:
            ValueError: they are no displacements of the same frames.
        """
        alike = backward.shape == forward.shape and backward.dtype == forward.dtype
        if not alike or not self.takes("forward_slices", forward.shape):
            raise ValueError(f"displacements of the shape {[*forward.shape]}")
        self.backward_slices = backward
        self.forward_slices = forward
        self.on_host = forward.device != self.here.device

    def keep(
        self,
        store: Literal["auto", "device", "host"],
        device: torch.device,
        shape: Shape,
        *,
        half: bool,
    ) -> None:
        """Choose where the frames are kept, before the clock of training starts.

        Args:
            store: on the device, on the host, or on the device if they fit there; several
                processes keep them on their devices.
            device: the device that they are learned on.
            shape: of their grids in the end.
            half: whether in half precision.
        """
        store = store if world_size() == 1 else "device"
        on_host = store == "host"
        if store == "auto" and device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(device)
            frames = len(self.forward_slices)
            on_host = not fits_on_device(free, frames, shape, half=half)
            if on_host:
                log.info(
                    "schedule.visit.store: frames stay on the host: %.1f GB are free on the GPU",
                    free / 1e9,
                )
        self.offload(on_host=on_host, half=half)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """An uninitialised tensor where displacements are kept."""
        return torch.empty(shape, dtype=dtype, device="cpu" if self.on_host else self.here.device)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> FrameStore:
        names = NAMES if self.on_host else ()
        frames = {name: self._buffers.pop(name) for name in names}
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._buffers.update(frames)
        return self


def fits_on_device(
    free: int, frames: int, shape: Shape, *, half: bool, learned: bool = True
) -> bool:
    """Whether T ``frames`` fit into ``free`` bytes of a GPU, with one that is ``learned``."""
    x, y, z = shape
    grid = x * y * z * DISPLACEMENT
    stored = 2 * frames * grid // (2 if half else 1)
    return stored + learned * ACTIVE_GRIDS * grid <= FRAMES_SHARE * free

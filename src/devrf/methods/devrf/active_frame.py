"""The frames that are being learned: copies of their displacements, and where their matter is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from devrf.data.pool import PixelPool
from devrf.geometry.box import Box
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.rendering.occupancy import Occupancy


@dataclass
class ActiveFrame:
    """A frame that is learned; one frame after another in the same memory.

    The field itself may rest elsewhere, or in half precision. What has been learned is the
    field's once it is written back (:meth:`write_back`).

    Attributes:
        number: the frame; 0 before the first.
        backward: (X, Y, Z, 3) its Δ_b, a leaf.
        forward: (X, Y, Z, 3) its Δ_f, a leaf.
        before: (X, Y, Z, 3) Δ_f of the frame before, frozen; zero for frame 0.
        occupancy: where the frame's matter is.
        box: where all of them live.
        pools: the pixels to learn from; batches are drawn from each in turn.
    """

    number: int
    backward: Tensor
    forward: Tensor
    before: Tensor
    occupancy: Occupancy
    box: Box
    pools: list[PixelPool] = field(default_factory=list)

    @staticmethod
    def of(motion: DeformationField, occupancy: Occupancy) -> ActiveFrame:
        """Memory for a frame of a field at its present resolution, on the field's device.

        Args:
            motion: the field.
            occupancy: of the size that the frame's own will have.
        """
        here = motion.frames.here
        backward, forward, before = (here.new_zeros(*motion.shape, 3) for _ in range(3))
        mask = torch.zeros_like(occupancy.mask)
        return ActiveFrame(
            0,
            backward.requires_grad_(),
            forward.requires_grad_(),
            before,
            Occupancy(mask, motion.box),
            motion.box,
        )

    @property
    def slices(self) -> tuple[Tensor, Tensor]:
        """Both directions of the frame."""
        return self.backward, self.forward

    @property
    def warp(self) -> GridWarp:
        """Points of the frame → canonical space."""
        return GridWarp((self.backward,), self.box)

    @property
    def unwarp(self) -> GridWarp:
        """Canonical points → the frame."""
        return GridWarp((self.forward,), self.box)

    def unwarp_previous(self, *, looked_up: bool) -> GridWarp:
        """Canonical points → the frame before.

        Args:
            looked_up: move points by zero for frame 1, too, before which nothing has moved:
                the same work for every frame.
        """
        return GridWarp((self.before,) if looked_up or self.number > 1 else (), self.box)

    def check_out(self, motion: DeformationField, number: int) -> None:
        """Copy a frame out of the field."""
        self.number = number
        motion.frames.read(number, self.slices)
        motion.frames.read_forward(number - 1, self.before)

    def write_back(self, motion: DeformationField) -> None:
        """Copy the frame back into the field; learning may go on."""
        if self.number:
            motion.frames.write(self.number, self.slices)


class ActiveFrames:
    """The frames that are learned at the same time, and the field that they belong to."""

    def __init__(self, module: nn.Module) -> None:
        """No frame yet.

        Args:
            module: a stage whose state holds the field: before it is saved the frames are
                written back, after it was loaded they are checked out again.
        """
        self._frames: list[ActiveFrame] = []
        self._field: DeformationField | None = None
        module.register_state_dict_pre_hook(  # type: ignore[no-untyped-call]
            lambda *_: self.write_back()
        )
        module.register_load_state_dict_post_hook(  # type: ignore[no-untyped-call]
            lambda *_: self._check_out_again()
        )

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[ActiveFrame]:
        return iter(self._frames)

    def __getitem__(self, number: int) -> ActiveFrame:
        return self._frames[number]

    def allocate(self, count: int, motion: DeformationField, occupancy: Occupancy) -> None:
        """Make memory for ``count`` frames at the field's present resolution."""
        self._frames = []  # the memory of those before is free before more is taken
        self._field = motion
        self._frames = [ActiveFrame.of(motion, occupancy) for _ in range(count)]

    def check_out(self, numbers: Sequence[int]) -> None:
        """Copy as many frames as there is memory for out of the field."""
        assert self._field is not None
        for frame, number in zip(self._frames, numbers, strict=True):
            frame.check_out(self._field, number)

    def write_back(self) -> None:
        """Copy what was learned of the frames into the field."""
        if self._field is not None and self._frames:
            for frame in self._frames:
                frame.write_back(self._field)
            self._field.frames.synchronize()

    def close(self) -> None:
        """Write the frames back, and free their memory."""
        self.write_back()
        self._frames = []

    def _check_out_again(self) -> None:
        for frame in self._frames:
            if frame.number and self._field is not None:
                frame.check_out(self._field, frame.number)

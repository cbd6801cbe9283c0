"""The active frames: copies of their slices while they are trained (docs/method.md#warp)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_grids import pack_bits, unpack_bits
from devrf.data.batch import PixelPool
from devrf.geometry.box import Box
from devrf.methods.devrf.appearance import AppearanceField, ColorResidual
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.rendering.occupancy import Occupancy


@dataclass
class ActiveFrame:
    """Memory for a frame that is trained; one frame after another uses it.

    The field itself may be kept on the host or in half precision; it knows what was learned once
    that is written back.

    Attributes:
        backward: (X, Y, Z, 3) Δ_b of the frame, a leaf.
        forward: (X, Y, Z, 3) Δ_f of the frame, a leaf.
        before: (X, Y, Z, 3) Δ_f of the frame before, frozen.
        occupancy: where something is at the frame's time.
        box: where the displacements live.
        still_outside: whether nothing moves outside the box.
        appearance: q → A_t(q) of the frame, its grid a leaf; None where it is not learned.
        number: the frame; 0 before the first.
        pools: the pixels to learn from; batches are drawn from each in turn.
    """

    backward: Tensor
    forward: Tensor
    before: Tensor
    occupancy: Occupancy
    box: Box
    still_outside: bool
    appearance: ColorResidual | None = None
    number: int = 0
    pools: list[PixelPool] = field(default_factory=list)

    @staticmethod
    def of(
        motion: DeformationField, occupancy: Occupancy, appearance: AppearanceField | None = None
    ) -> ActiveFrame:
        """Memory at the fields' resolutions, on their device, with an occupancy like the given."""
        backward, forward, before = (
            motion.frames.here.new_zeros(*motion.shape, 3) for _ in range(3)
        )
        empty = Occupancy(torch.zeros_like(occupancy.mask), occupancy.box)
        learned = backward.requires_grad_(), forward.requires_grad_()
        residual = None
        if appearance is not None:
            grid = torch.zeros_like(appearance.values[0]).requires_grad_()
            residual = ColorResidual(grid, appearance.box)
        return ActiveFrame(*learned, before, empty, motion.box, motion.still_outside, residual)

    @property
    def slices(self) -> tuple[Tensor, Tensor]:
        """Both directions of the frame."""
        return self.backward, self.forward

    @property
    def learned(self) -> list[Tensor]:
        """Everything that is learned of the frame."""
        return [*self.slices, *([] if self.residual is None else [self.residual])]

    @property
    def residual(self) -> Tensor | None:
        """(X', Y', Z', 3) A_t of the frame, if it is learned."""
        return None if self.appearance is None else self.appearance.grid

    @property
    def warp(self) -> GridWarp:
        """x → x + Δ_b(x, t)."""
        return self._by(self.backward)

    @property
    def unwarp(self) -> GridWarp:
        """q → q + Δ_f(q, t)."""
        return self._by(self.forward)

    def unwarp_previous(self, *, always_interpolate: bool) -> GridWarp:
        """q → q + Δ_f(q, t − 1), the identity for frame 1.

        Args:
            always_interpolate: look displacements of zero up for frame 1, too, so that every
                frame takes the same work.
        """
        return self._by(*[self.before] if always_interpolate or self.number > 1 else [])

    def _by(self, *slices: Tensor) -> GridWarp:
        return GridWarp(slices, self.box, still_outside=self.still_outside)

    @torch.no_grad()
    def check_out(
        self, motion: DeformationField, number: int, appearance: AppearanceField | None = None
    ) -> None:
        """Copy a frame out of the fields."""
        self.number = number
        motion.frames.read(number, self.slices)
        motion.frames.read_forward(number - 1, self.before)
        if self.residual is not None and appearance is not None:
            self.residual.copy_(appearance.values[number])

    def state(self, images: Tensor, area: int, *, exact: bool) -> dict[str, Any]:
        """Occupancy and pixels as plain data, for a progress file.

        Args:
            images: (K,) the images of the frame.
            area: pixels of an image.
            exact: add the displacements, which the field would round.
        """
        return {
            "occupancy": pack_bits(self.occupancy.mask),
            "shape": list(self.occupancy.mask.shape),
            "pixels": [pack_bits(pool.mask(images, area)) for pool in self.pools],
            "displacements": [tensor.detach().cpu() for tensor in self.slices if exact],
        }

    @torch.no_grad()
    def load_state(self, state: dict[str, Any], images: Tensor, area: int) -> None:
        """Restore what :meth:`state` gave; the frame has been checked out."""
        for tensor, value in zip(self.slices, state["displacements"], strict=False):
            tensor.copy_(value)
        device, shape = self.backward.device, (len(images), area)
        mask = unpack_bits(state["occupancy"], state["shape"], device)
        self.occupancy.refill(Occupancy(mask, self.occupancy.box))
        masks = [unpack_bits(bits, shape, device) for bits in state["pixels"]]
        self.pools = [PixelPool.of_mask(images, mask) for mask in masks]


class ActiveFrames:
    """The frames that are trained in parallel, and the field that they belong to."""

    def __init__(self, module: nn.Module) -> None:
        """No frame yet.

        Args:
            module: a stage whose state holds the field: before it is saved the frames are
                written back, after it was loaded they are checked out again.
        """
        self._frames: list[ActiveFrame] = []
        self._field: DeformationField | None = None
        self._appearance: AppearanceField | None = None
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

    def allocate(
        self,
        count: int,
        motion: DeformationField,
        occupancy: Occupancy,
        appearance: AppearanceField | None = None,
    ) -> None:
        """Make memory for ``count`` frames at the fields' present resolutions.

        Args:
            count: how many frames are trained in parallel.
            motion: their displacements.
            occupancy: at rest.
            appearance: their residuals; None where they are not learned.
        """
        self._frames = []  # frees the memory of those before
        self._field, self._appearance = motion, appearance
        self._frames = [ActiveFrame.of(motion, occupancy, appearance) for _ in range(count)]

    def check_out(self, numbers: Sequence[int]) -> None:
        """Copy as many frames as there is memory for out of the field."""
        assert self._field is not None
        for frame, number in zip(self._frames, numbers, strict=True):
            frame.check_out(self._field, number, self._appearance)

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy what was learned of the frames into the fields; learning may go on."""
        if self._field is not None and self._frames:
            for frame in self._frames:
                if frame.number:
                    self._field.frames.write(frame.number, frame.slices)
                    if frame.residual is not None and self._appearance is not None:
                        self._appearance.values[frame.number].copy_(frame.residual)
            self._field.frames.synchronize()

    def close(self) -> None:
        """Write the frames back, and free their memory."""
        self.write_back()
        self._frames = []

    def _check_out_again(self) -> None:
        for frame in self._frames:
            if frame.number and self._field is not None:
                frame.check_out(self._field, frame.number, self._appearance)

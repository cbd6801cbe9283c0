"""What is at hand while a frame is visited: copies of what is learned of it, and its matter."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from devrf.data.pool import PixelPool
from devrf.geometry.box import Box
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.rendering.occupancy import Occupancy


@dataclass
class ActiveFrame:
    """The frames of a level, one after another, in the same memory.

    The field itself may rest elsewhere. What a visit has learned is the field's when it is left,
    and whenever somebody wants to see the field (:meth:`leave`).

    Attributes:
        frame: the frame that is visited; 0 before the first.
        backward: (X, Y, Z, 3) its Δ_b, a leaf.
        forward: (X, Y, Z, 3) its Δ_f, a leaf.
        before: (X, Y, Z, 3) Δ_f of the frame before, frozen; zero for frame 0.
        occupancy: where the frame's matter is.
        box: where all of them live.
        pools: the pixels to learn from; batches are drawn from each in turn.
    """

    frame: int
    backward: Tensor
    forward: Tensor
    before: Tensor
    occupancy: Occupancy
    box: Box
    pools: list[PixelPool] = field(default_factory=list)

    @staticmethod
    def of(motion: DeformationField, occupancy: Occupancy) -> ActiveFrame:
        """Room for the frames of a field at its present resolution, where the field works.

        Args:
            motion: the field.
            occupancy: what that of a frame will be as large as.
        """
        backward, forward, before = (motion.here.new_zeros(*motion.shape, 3) for _ in range(3))
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
        return GridWarp((self.before,) if looked_up or self.frame > 1 else (), self.box)

    def enter(self, motion: DeformationField, frame: int) -> None:
        """Take a frame out of the field."""
        self.frame = frame
        motion.read(frame, self.slices)
        motion.read_forward(frame - 1, self.before)

    def leave(self, motion: DeformationField) -> None:
        """Put the frame back into the field; the visit may go on."""
        if self.frame:
            motion.write(self.frame, self.slices)

"""The active frame: a copy of its slices while it is trained (docs/method.md#warp)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import pack_bits, unpack_bits
from devrf.data.batch import PixelPool
from devrf.methods.devrf.frame_store import FrameField, FrameStore
from devrf.methods.devrf.pixel_pools import images_of
from devrf.rendering.occupancy import Occupancy
from devrf.scenes.scene import Views


class ActiveFrame:
    """Memory for a frame that is trained; one frame after another uses it.

    The field has the result once that is written back.

    Attributes:
        store: the displacements of all frames.
        backward: (X, Y, Z, 3) Δ_b of the frame, a leaf.
        forward: (X, Y, Z, 3) Δ_f of the frame, a leaf.
        previous_forward: (X, Y, Z, 3) Δ_f of the frame before, frozen.
        occupancy: at the frame's time.
        fields: further fields (T, …) whose frames are learned, by name.
        further: the frame's slice of each, a leaf.
        number: the frame; 0 before the first.
        pools: the pixels to learn from; batches are drawn from each in turn.
    """

    def __init__(
        self, store: FrameStore, occupancy: Occupancy, fields: Mapping[str, FrameField]
    ) -> None:
        """Memory at the fields' present resolutions, on their device.

        Args:
            store: the displacements of all frames.
            occupancy: at rest; the frame's is as large.
            fields: further fields whose frames are learned, by name.
        """
        zeros = store.here.new_zeros(*store.shape, 3)
        self.store = store
        self.backward = zeros.clone().requires_grad_()
        self.forward = zeros.clone().requires_grad_()
        self.previous_forward = zeros
        self.occupancy = Occupancy(torch.zeros_like(occupancy.mask), occupancy.box)
        self.fields = fields
        self.further = {
            name: torch.zeros_like(field.values[0]).requires_grad_()
            for name, field in fields.items()
        }
        self.number = 0
        self.pools: list[PixelPool] = []

    @property
    def slices(self) -> tuple[Tensor, Tensor]:
        """Both directions of the frame."""
        return self.backward, self.forward

    @torch.no_grad()
    def check_out(self, number: int) -> None:
        """Copy a frame out of the fields."""
        self.number = number
        self.store.read(number, self.slices)
        self.previous_forward.copy_(self.store.forward_slices[number - 1])
        for name, values in self.further.items():
            values.copy_(self.fields[name].values[number])

    @torch.no_grad()
    def write_back(self) -> None:
        """Copy the result into the fields; learning may go on."""
        if self.number:
            self.store.write(self.number, self.slices)
            for name, values in self.further.items():
                self.fields[name].values[self.number].copy_(values)

    def state(self, views: Views, *, exact: bool) -> dict[str, Any]:
        """Occupancy and pixels as plain data, for a progress file.

        Args:
            views: the training views.
            exact: add the displacements, which the field would round.
        """
        images = images_of(views, self.number)
        area = views.height * views.width
        return {
            "occupancy": pack_bits(self.occupancy.mask),
            "pixels": [pack_bits(pool.mask(images, area)) for pool in self.pools],
            "displacements": [tensor.detach().cpu() for tensor in self.slices if exact],
        }

    @torch.no_grad()
    def load_state(self, state: dict[str, Any], views: Views) -> None:
        """Restore the result of :meth:`state`; the frame has been checked out.

        Raises:
            ValueError: there is no pixel in it, or other masks.
        """
        images = images_of(views, self.number)
        area = views.height * views.width
        for tensor, value in zip(self.slices, state["displacements"], strict=False):
            tensor.copy_(value)
        device = self.backward.device
        mask = unpack_bits(state["occupancy"], self.occupancy.mask.shape, device)
        self.occupancy.refill(Occupancy(mask, self.occupancy.box))
        masks = [unpack_bits(bits, (len(images), area), device) for bits in state["pixels"]]
        self.pools = [PixelPool.of_mask(images, mask) for mask in masks]
        if not self.pools or not all(map(len, self.pools)):
            raise ValueError("no pixels to learn from")

"""What belongs to one of the batches of an iteration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from devrf.data.batch import Pixels
from devrf.rendering.room import Room


@dataclass
class Lane:
    """One of the batches of an iteration, beside others that have nothing to do with it.

    Attributes:
        number: which one, from 0.
        parameters: what is learned from it, and from no other.
        room: the length of its lists of samples; None while they are as long as need be.
        pixels: the batch of the present iteration; None before the first.
    """

    number: int
    parameters: Sequence[Tensor]
    room: Room | None = None
    pixels: Pixels | None = None

    def take(self, drawn: Pixels) -> None:
        """Make ``drawn`` the batch; in the memory of the one before if iterations are steady."""
        if self.room is None:
            self.pixels = drawn
        elif self.pixels is None:
            self.pixels = drawn.clone()
        else:
            self.pixels.take(drawn)

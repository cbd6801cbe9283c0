"""One of the batches of an iteration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from devrf.data.batch import Pixels
from devrf.rendering.sample_capacity import SampleCapacity


@dataclass
class ParallelBatch:
    """One of the batches that an iteration learns from, independent of the others.

    Attributes:
        number: which one, from 0.
        parameters: what is learned from it, and from no other.
        capacity: the length of its lists of samples; None while they are as long as need be.
        pixels: the pixels of the present iteration; None before the first.
    """

    number: int
    parameters: Sequence[Tensor]
    capacity: SampleCapacity | None = None
    pixels: Pixels | None = None

    def take(self, drawn: Pixels) -> None:
        """Make ``drawn`` the pixels; in the memory of those before if shapes are static."""
        if self.capacity is None:
            self.pixels = drawn
        elif self.pixels is None:
            self.pixels = drawn.clone()
        else:
            self.pixels.take(drawn)

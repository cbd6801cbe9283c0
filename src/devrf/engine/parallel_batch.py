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
        number: its index in the iteration, from 0.
        parameters: what is learned from it, and from no other batch.
        capacity: the length of its sample lists; None where their length depends on data.
        pixels: the pixels of the present iteration; None before the first.
    """

    number: int
    parameters: Sequence[Tensor]
    capacity: SampleCapacity | None = None
    pixels: Pixels | None = None

    def take(self, drawn: Pixels) -> None:
        """Set the pixels to ``drawn``; with a capacity, copy them into the same memory."""
        if self.capacity is None:
            self.pixels = drawn
        elif self.pixels is None:
            self.pixels = drawn.clone()
        else:
            self.pixels.take(drawn)

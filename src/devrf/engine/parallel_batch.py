"""What belongs to each of the batches of an iteration, and what they come to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import average
from devrf.rendering.sample_capacity import SampleCapacity


@dataclass
class ParallelBatch:
    """One of the batches of an iteration, beside others that have nothing to do with it.

    Attributes:
        number: which one, from 0.
        parameters: what is learned from it, and from no other.
        room: the length of its lists of samples; None while they are as long as need be.
        pixels: the batch of the present iteration; None before the first.
    """

    number: int
    parameters: Sequence[Tensor]
    room: SampleCapacity | None = None
    pixels: Pixels | None = None

    def take(self, drawn: Pixels) -> None:
        """Make ``drawn`` the batch; in the memory of the one before if iterations are steady."""
        if self.room is None:
            self.pixels = drawn
        elif self.pixels is None:
            self.pixels = drawn.clone()
        else:
            self.pixels.take(drawn)


class MetricAccumulator:
    """Losses and their terms, lane by lane, added up over the iterations of a Lightning step.

    From the first addition on they stay in the same memory.
    """

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._values: Tensor | None = None  # (lanes, names)

    def add(self, found: Sequence[Mapping[str, Tensor]]) -> None:
        """Add what an iteration has come to: scalars by name for each lane, all the same names."""
        self._names = tuple(found[0])
        values = torch.stack([terms[name] for terms in found for name in self._names])
        values = values.view(len(found), len(self._names))
        if self._values is None:
            self._values = values
        else:
            self._values += values

    def take(self, iterations: int) -> tuple[dict[str, Tensor], Tensor]:
        """The means over some iterations and all processes, of which nothing is kept.

        Returns:
            Of each name the mean over the lanes, (); of each lane its ``loss``, (lanes,).
        """
        assert self._values is not None
        means = average(self._values) / iterations
        self._values.zero_()
        together = means.mean(dim=0).unbind()
        return dict(zip(self._names, together, strict=True)), means[:, self._names.index("loss")]

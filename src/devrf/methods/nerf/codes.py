"""Codes: learned vectors, one for each frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from devrf.geometry.clock import FrameClock

# They begin uniform in [0, LARGEST).
LARGEST = 0.05


class TimeCodes(nn.Module):
    """A code ω_t for each frame, shared by all cameras; between two frames a mixture of theirs.

    At frames' own times this is what was published; what is between them was never learned
    (docs/methods/nerfies.md#codes).

    Attributes:
        clock: the frames' times.
    """

    def __init__(self, times: Sequence[float], size: int) -> None:
        """Draw the codes.

        Args:
            times: of the frames, in [0, 1], ascending from 0.
            size: length of a code.
        """
        super().__init__()
        self.clock = FrameClock(tuple(times))
        self.table = nn.Embedding(len(self.clock), size)
        nn.init.uniform_(self.table.weight, 0, LARGEST)

    def forward(self, time: Tensor) -> Tensor:
        """Codes (M, size) at times (M,) in [0, 1]."""
        before, after, weight = self.clock.between(time)
        code: Tensor = torch.lerp(self.table(before), self.table(after), weight[:, None])
        return code

"""A field of the dynamic scene: grids of T frames over a box."""

from __future__ import annotations

from typing import Any

from torch import nn

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock


class FrameField(nn.Module):
    """Where the grids of T frames are, in space and in time; kept in checkpoints.

    Attributes:
        box: where the field lives.
        clock: the times of the T frames.
    """

    def __init__(self, box: Box, clock: FrameClock) -> None:
        super().__init__()
        self.box = box
        self.clock = clock

    def get_extra_state(self) -> dict[str, Any]:
        """Box and clock, as plain numbers."""
        low, high = list(self.box.low), list(self.box.high)
        return {"low": low, "high": high, "times": list(self.clock.times)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave."""
        self.box = Box.of(state["low"], state["high"])
        self.clock = FrameClock(tuple(state["times"]))

"""The number of rays of a batch: fewer than scheduled for want of memory or of time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass
class BatchSize:
    """The share of the schedule's batches that is drawn.

    Attributes:
        share: of a batch, by all processes together.
        largest: the most that memory suffices for: less than 1 after it has run out.
        smallest: the least to which batches are halved where memory runs out.
        processes: the number of processes that draw a batch together.
    """

    share: float = 1.0
    largest: float = 1.0
    smallest: float = 0.5
    processes: int = 1

    @property
    def of_process(self) -> float:
        """The share of the schedule's batches that one process draws."""
        return self.share / self.processes

    def rays(self, rays: int, most: int | None = None) -> int:
        """The number of rays that one process draws of a batch of ``rays``, or of at ``most``."""
        whole = rays if most is None else min(rays, most)
        return max(1, round(whole * self.of_process))

    def halve(self) -> bool:
        """Draw half of the rays from now on, unless that is less than the smallest share."""
        if self.share / 2 < self.smallest:
            return False
        self.share /= 2
        self.largest = self.share
        return True

    def state(self) -> dict[str, Any]:
        """The shares, for a progress file."""
        return {"batch_share": self.share, "largest_share": self.largest}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take what :meth:`state` gave."""
        self.share = state["batch_share"]
        self.largest = state["largest_share"]

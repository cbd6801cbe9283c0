"""The number of rays of a batch: fewer than scheduled for want of memory or of time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

from devrf.engine.grid_adam import GridAdam
from devrf.errors import DevrfError
from devrf.system.memory import OutOfMemoryError, free_cache, is_oom, numbers

log = logging.getLogger(__name__)

Result = TypeVar("Result")


@dataclass
class BatchSize:
    """The share of the schedule's batches that is drawn.

    Attributes:
        share: of a batch, by all processes together.
        largest: the most that memory suffices for: less than 1 after it has run out.
        smallest: the least to which batches are halved where memory runs out.
        processes: the number of processes that draw a batch together.
        keys: the config keys of what to lower where even that is too much.
        is_final: whether the optimiser is stepping, and the batch cannot be drawn again.
        is_timed: whether a budget of seconds decides on the share.
    """

    share: float = 1.0
    largest: float = 1.0
    smallest: float = 0.5
    processes: int = 1
    keys: tuple[str, ...] = ()
    is_final: bool = False
    is_timed: bool = False

    @property
    def of_process(self) -> float:
        """The share of the schedule's batches that one process draws."""
        return self.share / self.processes

    def rays(self, rays: int, most: int | None = None) -> int:
        """One process's part of a batch of ``rays``, or pixels; of ``most`` where that is less."""
        whole = rays if most is None else min(rays, most)
        return max(1, round(whole * self.of_process))

    def attempt(
        self, iterate: Callable[[], Result], optimizer: GridAdam, device: torch.device
    ) -> Result:
        """``iterate()``; where memory runs out, again with half of the rays, from now on.

        Raises:
            OutOfMemoryError: half is less than the smallest share; no parameter has changed.
            DevrfError: there are several processes: the others already wait for this one.
        """
        while True:
            try:
                optimizer.make_gradients()  # Lightning drops them where a run is resumed
                return iterate()
            except (RuntimeError, MemoryError) as error:
                if self.is_final or not is_oom(error):
                    raise
                shortage = f"out of memory ({numbers(str(error), device)})"
            # Outside the handler, where the error's traceback no longer holds the batch.
            optimizer.zero_grad()
            free_cache(device)
            if self.processes > 1:
                raise DevrfError(
                    f"schedule: one of {self.processes} processes is {shortage}; fewer rays, "
                    "smaller grids or more processes"
                )
            if self.share / 2 < self.smallest:
                lower = f"lower {' or '.join(self.keys)}, or " if self.keys else ""
                raise OutOfMemoryError(
                    f"{shortage}; the same command goes on where there is more memory; with less, "
                    f"begin afresh (resume=false) with {lower}higher data.downscale"
                )
            self.share /= 2
            self.largest = self.share
            log.warning("%s: batches have half of their rays from now on", shortage)

    def state(self) -> dict[str, Any]:
        """The shares, for a progress file."""
        return {"batch_share": self.share, "largest_share": self.largest}

    def load(self, state: Mapping[str, Any]) -> None:
        """Take what :meth:`state` gave."""
        self.share = state["batch_share"]
        self.largest = state["largest_share"]

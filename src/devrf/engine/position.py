"""Where a stage is in its schedule, and what its next random numbers are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import torch


@dataclass
class Position:
    """A place in a schedule; a progress file holds these numbers by name.

    Attributes:
        iteration: the next iteration.
        iterations_done: optimiser iterations that were carried out.
        seed: of the whole run.
        num_rollbacks: number of times that training diverged and was rolled back.
        lr_scale: factor of the scheduled learning rates; below 1 after a rollback.
        schedule_scale: the scheduled iterations, as a factor of those configured
            (``schedule.seconds``).
        ended_early: whether an ``EarlyStopping`` callback has ended the stage.
    """

    iteration: int = 0
    iterations_done: int = 0
    seed: int = 0
    num_rollbacks: int = 0
    lr_scale: float = 1.0
    schedule_scale: float = 1.0
    ended_early: bool = False

    def advance(self) -> None:
        """Count an iteration that was carried out."""
        self.iteration += 1
        self.iterations_done += 1

    def is_due(self, every: int, start: int) -> bool:
        """Whether the next iteration is a multiple of ``every`` iterations after ``start``."""
        passed = self.iteration - start
        return passed > 0 and passed % every == 0

    def seed_generator(self, generator: torch.Generator, rank: int) -> None:
        """Seed a generator for the next Lightning step, differently in each process."""
        numbers = [self.seed, rank, self.iterations_done, self.num_rollbacks]
        mixed = np.random.SeedSequence(numbers)
        generator.manual_seed(int(mixed.generate_state(1, np.uint64)[0]))

    def roll_back(self, iteration: int, iterations_done: int, lr_scale: float) -> None:
        """Return to an earlier iteration, with learning rates ``lr_scale`` times as high."""
        self.iteration = iteration
        self.iterations_done = iterations_done
        self.num_rollbacks += 1
        self.lr_scale *= lr_scale

    def state(self) -> dict[str, Any]:
        """The numbers by name."""
        return asdict(self)

    def load(self, state: Mapping[str, Any]) -> None:
        """Take what :meth:`state` gave."""
        for entry in fields(self):
            setattr(self, entry.name, state[entry.name])

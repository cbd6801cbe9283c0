"""What counts as divergence, and the state that a rollback returns to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from devrf.engine.stage import Phase, ScheduledStage

# An expected opacity (or transparency) below this is too small to judge by.
FAINT = 0.02
# Shares of the expected opacity: seen before, and as good as gone.
THERE, GONE = 0.1, 0.01
# Shares of the expected transparency. Much light passes beside the field whatever happens.
CLEAR, BLOCKED = 0.8, 0.5
# Frames that a frame is compared with, and the fewest that allow a comparison.
NEIGHBOURS, FEWEST = 10, 4
# Standard deviations of log loss that a frame may be off, and the least that counts as one: losses
# of frames differ by a quarter without a cause.
DEVIATIONS, SPREAD = 5.0, 0.25
# Growing motion raises the loss gradually; a faulty frame raises it at once, by this factor.
JUMP = 2.0


@dataclass(frozen=True)
class Snapshot:
    """What a stage was training at an iteration of a phase.

    Attributes:
        phase: the phase.
        iteration: the iteration.
        values: copies of the optimiser's parameters, in its order, on the same device.
    """

    phase: Phase
    iteration: int
    values: tuple[Tensor, ...]

    @staticmethod
    def of(stage: ScheduledStage) -> Snapshot:
        """The present state of a stage that has entered a phase."""
        assert stage.phase is not None
        values = tuple(value.detach().clone() for value in _trained(stage))
        return Snapshot(stage.phase, stage.iteration, values)

    @torch.no_grad()
    def restore(self, stage: ScheduledStage, lr_scale: float) -> None:
        """Roll the stage back to this state, with learning rates multiplied by ``lr_scale``."""
        for value, kept in zip(_trained(stage), self.values, strict=True):
            value.copy_(kept)
        stage.rollback(self.iteration, lr_scale)


def _trained(stage: ScheduledStage) -> list[Tensor]:
    return [value for group in stage.optimizer.param_groups for value in group["params"]]


@torch.no_grad()
def read(stage: ScheduledStage, steps: Sequence[Mapping[str, Tensor]]) -> list[dict[str, float]]:
    """The values of steps, then one row with the sum of each parameter group, by name.

    A sum is not finite if any value is not. This is the one place that waits for the device.

    Args:
        stage: gives the parameter groups.
        steps: means of each step by name, () each.
    """
    fields: dict[str, Tensor] = {}
    for group in stage.optimizer.param_groups:
        sums = [value.sum(dtype=torch.float32) for value in group["params"]]
        fields[group["name"]] = torch.stack(sums).sum() if sums else torch.zeros(())
    rows = [*steps, fields]
    flat = [value.float().to(stage.device) for row in rows for value in row.values()]
    numbers = iter(torch.stack(flat).tolist())
    return [{name: next(numbers) for name in row} for row in rows]


def not_finite(values: Mapping[str, float]) -> str | None:
    """The name of the first value that is infinite or not a number, if there is one."""
    return next((name for name, value in values.items() if not math.isfinite(value)), None)


def emptied(seen: float, most: float, expected: float) -> bool:
    """Whether what should be seen was there and is gone.

    Args:
        seen: the mean opacity of rays.
        most: the highest mean opacity so far.
        expected: what it should be.
    """
    return expected > FAINT and most > THERE * expected and seen < GONE * expected


def filled(seen: float, least: float, expected: float) -> bool:
    """Whether light that should pass did so, and no longer does.

    Args:
        seen: the mean opacity of rays.
        least: the lowest mean opacity so far.
        expected: what it should be.
    """
    clear = 1 - expected
    return clear > FAINT and 1 - least > CLEAR * clear and 1 - seen < BLOCKED * clear


def stands_out(loss: float, others: Sequence[float]) -> float | None:
    """By what factor a frame's loss exceeds its neighbours', if it is an outlier.

    The range is the median and the median absolute deviation of log losses, which a few outliers
    do not move.

    Args:
        loss: of the frame, above 0.
        others: of the frames visited before it, the last one last.
    """
    near = [math.log(other) for other in others[-NEIGHBOURS:] if other > 0]
    if len(near) < FEWEST or not loss > JUMP * others[-1]:
        return None
    middle = median(near)
    spread = 1.4826 * median(abs(other - middle) for other in near)
    above = math.log(loss) - middle
    return math.exp(above) if above > DEVIATIONS * max(spread, SPREAD) else None

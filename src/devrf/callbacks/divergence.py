"""Whether learning goes well, and what to go back to when it does not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from devrf.engine.phase import Phase
from devrf.engine.stage import ScheduledStage

# Where less than this should be seen, nothing is said of what is.
FAINT = 0.02
# As much of the matter that should be seen has been there before; as little is as good as none.
THERE, GONE = 0.1, 0.01
# The same of the light that should pass. Much of it passes beside the field, whatever happens.
CLEAR, BLOCKED = 0.8, 0.5
# Frames that a frame is compared with, and how many it takes.
NEIGHBOURS, FEWEST = 10, 4
# Deviations (of a normal distribution) that a frame may be off, and the least that counts as one:
# losses of frames differ by a quarter for no reason.
DEVIATIONS, SPREAD = 5.0, 0.25
# Motion that grows from frame to frame raises the loss little by little; what is wrong with a
# frame raises it at once, by this factor of the frame before.
JUMP = 2.0


@dataclass(frozen=True)
class Snapshot:
    """What a stage was training at an iteration of a phase.

    Attributes:
        phase: the phase.
        iteration: the iteration.
        values: copies of what the optimiser holds, in its order, on the same device.
    """

    phase: Phase
    iteration: int
    values: tuple[Tensor, ...]

    @staticmethod
    def of(stage: ScheduledStage) -> Snapshot:
        """The present state of a stage that has entered a phase."""
        assert stage.phase is not None
        values = tuple(value.detach().clone() for value in trained(stage))
        return Snapshot(stage.phase, stage.iteration, values)

    @torch.no_grad()
    def put_back(self, stage: ScheduledStage, lr_scale: float) -> None:
        """Let the stage go on from here, more cautiously."""
        for value, kept in zip(trained(stage), self.values, strict=True):
            value.copy_(kept)
        stage.rollback(self.iteration, lr_scale)


def trained(stage: ScheduledStage) -> list[Tensor]:
    """What the stage's optimiser holds."""
    return [value for group in stage.optimizer.param_groups for value in group["params"]]


@torch.no_grad()
def read(stage: ScheduledStage, steps: Sequence[Mapping[str, Tensor]]) -> list[dict[str, float]]:
    """The values of steps, and behind them one row of what is trained, by name.

    The one place where the device is waited for. Of what is trained it is the sum that is
    read: not finite if any value is not.

    Args:
        stage: gives what is trained.
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
    """Whether matter that should be seen was there and is gone; all are shares of the rays.

    Args:
        seen: the mean opacity of rays.
        most: the highest that it was before.
        expected: what it should be.
    """
    return expected > FAINT and most > THERE * expected and seen < GONE * expected


def filled(seen: float, least: float, expected: float) -> bool:
    """Whether light that should pass did so, and does no more; all are shares of the rays.

    Args:
        seen: the mean opacity of rays.
        least: the lowest that it was before.
        expected: what it should be.
    """
    clear = 1 - expected
    return clear > FAINT and 1 - least > CLEAR * clear and 1 - seen < BLOCKED * clear


def stands_out(loss: float, others: Sequence[float]) -> float | None:
    """By what factor a frame's loss exceeds its neighbours', if that is beyond their range.

    Their range is told by median and median absolute deviation of logarithms, which a few that
    are off themselves do not move.

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

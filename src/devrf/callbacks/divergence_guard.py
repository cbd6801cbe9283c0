"""Notices divergence: says what happened, goes back once with lower learning rates, then stops."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from statistics import mean
from typing import Any, NamedTuple

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from devrf.engine.schedule import Phase
from devrf.engine.stage import Stage, place_of
from devrf.errors import DevrfError
from devrf.system.plain_data import validate

log = logging.getLogger(__name__)

BACKGROUND = "is data.background that of the images, data.box around what they show?"
# Iterations between snapshots in a long phase.
SNAPSHOT_EVERY = 1000
# The fewest iterations, as carried out, between checks that allow a judgement of opacity.
MIN_ITERATIONS = 20
# An expected opacity (or transparency) below this is too small to judge by.
MIN_EXPECTED = 0.02
# Shares of the expected opacity: seen before, and as good as gone.
MIN_SEEN = 0.1
MAX_GONE = 0.01
# Shares of the expected transparency. Much light passes beside the field whatever happens.
MIN_CLEAR = 0.8
MAX_CLEAR_LEFT = 0.5


def collapsed_to_empty(opacity: float, highest: float, expected: float) -> bool:
    """Whether what should be seen was there and is gone.

    All are mean opacities of rays: ``opacity`` now, the highest so far, and what it should be.
    """
    return (
        expected > MIN_EXPECTED and highest > MIN_SEEN * expected and opacity < MAX_GONE * expected
    )


def collapsed_to_opaque(opacity: float, lowest: float, expected: float) -> bool:
    """Whether light that should pass did so, and no longer does; ``lowest``: the lowest so far."""
    clear = 1 - expected
    return (
        clear > MIN_EXPECTED
        and 1 - lowest > MIN_CLEAR * clear
        and 1 - opacity < MAX_CLEAR_LEFT * clear
    )


class Snapshot(NamedTuple):
    """Copies of the optimiser's parameters, in its order, at an iteration of a phase.

    ``iterations_done`` had been carried out there; ``restore`` restores what else had changed.
    """

    phase: Phase
    iteration: int
    iterations_done: int
    values: tuple[Tensor, ...]
    restore: Callable[[], None]


class DivergenceGuard(Callback):
    """Checks every so often that losses and fields are finite and that something can be seen.

    If not, the stage returns to its last good snapshot (at the latest of the phase's start; for
    the deformation, of the frame's) and goes on with lower learning rates and other pixels. The
    second time the stage ends in that state. Nothing is read from the device between checks.
    """

    def __init__(self, every_iterations: int = 100, rate_factor: float = 0.5) -> None:
        """Say how often to check, and how to go on.

        Args:
            every_iterations: between checks; there is also one where a phase ends and before a
                progress file is written.
            rate_factor: factor of learning rates after a rollback.
        """
        if every_iterations < 1 or not 0 < rate_factor <= 1:
            raise DevrfError(
                "callbacks.divergence_guard: expected every_iterations of 1 or more and a "
                f"rate_factor above 0, at most 1, not {every_iterations} and {rate_factor}"
            )
        self.every_iterations = every_iterations
        self.rate_factor = rate_factor
        self._reset()

    def _reset(self) -> None:
        self._steps: list[tuple[int, dict[str, Tensor]]] = []
        self._good: Snapshot | None = None
        self._checked = 0
        # Of the opacity, since grids of this kind are learned.
        self._kind = ""
        self._range = [1.0, 0.0]

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self._reset()

    def state_dict(self) -> dict[str, Any]:
        """The values that later checks compare with."""
        return {"kind": self._kind, "range": list(self._range)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Compare with what :meth:`state_dict` gave."""
        self._kind = state_dict["kind"]
        self._range = [*validate(tuple[float, float], state_dict["range"])]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count from here."""
        assert isinstance(pl_module, Stage)
        self._count_from(pl_module)

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Take a snapshot where a phase begins."""
        assert isinstance(pl_module, Stage)
        phase = pl_module.phase
        if phase is None or (self._good is not None and self._good.phase == phase):
            return
        if self._steps:  # its schedule was scaled: what it has come to was not looked at yet
            self.check(pl_module)
        self._snapshot(pl_module)
        if phase.kind != self._kind:
            self._kind = phase.kind
            if phase.frame is None:
                self._range = [1.0, 0.0]  # a new field begins as fog

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep the step's losses; check, if it is due."""
        assert isinstance(pl_module, Stage) and pl_module.phase is not None
        done = pl_module.position.iteration
        if outputs:
            self._steps.append((done, outputs))
        ends = done >= min(pl_module.phase.stop, pl_module.schedule.total)
        since = pl_module.position.iterations_done - self._checked
        if ends or since >= self.every_iterations:
            self.check(pl_module)

    def check(self, stage: Stage) -> None:
        """Roll the stage back, or end it, if it has diverged since the last check."""
        if not self._steps:
            return
        iterations = [done for done, _ in self._steps]
        since = stage.position.iterations_done - self._checked
        *steps, fields = _read(stage, [means for _, means in self._steps])
        self._steps = []
        self._count_from(stage)
        wrong = _not_finite(stage, iterations, steps, fields)
        wrong = wrong or self._collapsed(stage, steps, since)
        assert self._good is not None and stage.phase is not None
        if wrong is not None:
            self._rollback(stage, self._good, wrong)
        elif stage.phase.stop > stage.position.iteration >= self._good.iteration + SNAPSHOT_EVERY:
            self._snapshot(stage)

    def _count_from(self, stage: Stage) -> None:
        self._checked = stage.position.iterations_done

    def _snapshot(self, stage: Stage) -> None:
        assert stage.phase is not None
        self._good = None  # its memory is free before the next takes as much
        values = tuple(value.detach().clone() for value in _trained(stage))
        self._good = Snapshot(
            phase=stage.phase,
            iteration=stage.position.iteration,
            iterations_done=stage.position.iterations_done,
            values=values,
            restore=stage.remember(),
        )

    def _collapsed(self, stage: Stage, steps: Sequence[dict[str, float]], since: int) -> str | None:
        """In words, that everything has become empty or opaque."""
        late = steps[len(steps) // 2 :]
        opacity = mean(means["opacity"] for means in late)
        # Only alpha masks say what should be seen.
        covered = mean(means["coverage"] for means in late) if "coverage" in late[0] else None
        lowest, highest = self._range
        where = f"{place_of(stage, stage.position.iteration)} ({BACKGROUND})"
        if since >= MIN_ITERATIONS:
            self._range = [min(lowest, opacity), max(highest, opacity)]
            if covered is not None and collapsed_to_opaque(opacity, lowest, covered):
                return f"everything has become opaque by {where}"
            # Without alpha masks, what moves may have left the picture.
            judged = covered is not None or stage.capture == "static"
            if judged and collapsed_to_empty(
                opacity, highest, highest if covered is None else covered
            ):
                return f"everything has become empty by {where}"
        ends = stage.position.iteration >= stage.schedule.total
        if ends and opacity < MAX_GONE * (covered or MIN_SEEN):
            log.warning("%s: nothing is to be seen at the end (%s)", stage.name, BACKGROUND)
        return None

    @torch.no_grad()
    def _rollback(self, stage: Stage, good: Snapshot, wrong: str) -> None:
        """Restore the last good state; the second time, end there."""
        again = stage.position.num_rollbacks > 0
        scale = stage.position.lr_scale
        for value, stored in zip(_trained(stage), good.values, strict=True):
            value.copy_(stored)
        scaled = good.phase != stage.phase  # iterations are numbered otherwise since then
        iteration = stage.position.iteration if scaled else good.iteration
        stage.position.roll_back(iteration, good.iterations_done, self.rate_factor)
        stage.optimizer.forget()
        good.restore()
        stage.seed_random()
        stage.trainer.should_stop = False
        self._count_from(stage)
        if again:
            stage.abort(
                f"{wrong}, again after learning rates were cut to {scale:g}; what it was at "
                f"iteration {iteration} is kept; lower {stage.rate_keys}, and begin afresh "
                "with resume=false"
            )
            return
        log.warning(
            "%s: %s: back to iteration %d, learning rates at %g of the schedule's",
            stage.name,
            wrong,
            iteration,
            stage.position.lr_scale,
        )


def _trained(stage: Stage) -> list[Tensor]:
    return [value for group in stage.optimizer.param_groups for value in group["params"]]


@torch.no_grad()
def _read(stage: Stage, steps: Sequence[Mapping[str, Tensor]]) -> list[dict[str, float]]:
    """The values of steps, then one row with the sum of each parameter group, by name.

    A sum is not finite if any value is not. This is the one place that waits for the device.
    """
    fields: dict[str, Tensor] = {}
    for group in stage.optimizer.param_groups:
        sums = [value.sum(dtype=torch.float32) for value in group["params"]]
        fields[group["name"]] = torch.stack(sums).sum() if sums else torch.zeros(())
    rows = [*steps, fields]
    flat = [value.float().to(stage.device) for row in rows for value in row.values()]
    numbers = iter(torch.stack(flat).tolist())
    return [{name: next(numbers) for name in row} for row in rows]


def _not_finite(
    stage: Stage,
    iterations: Sequence[int],
    steps: Sequence[Mapping[str, float]],
    fields: Mapping[str, float],
) -> str | None:
    """The value that is not finite, and where that was first seen, in words."""
    for iteration, means in zip(iterations, steps, strict=True):
        for name, value in means.items():
            if not math.isfinite(value):
                term = "the loss" if name == "loss" else f"the loss term {name}"
                return f"{term} is {value} by {place_of(stage, iteration)}"
    for name, value in fields.items():
        if not math.isfinite(value):
            return f"values of {name} are not finite by {place_of(stage, stage.position.iteration)}"
    return None

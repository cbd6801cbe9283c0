"""Scales a stage's schedule to a budget of wall time: ``schedule.seconds=N``.

A short trial measures what iterations take, of two sizes of batches. Then the schedule is scaled
(:func:`~devrf.engine.schedule.scale_schedule`): growths, decays and curricula take place as
they do in the configured one. It is scaled again when the kind of phase has changed, and when a
quarter of the time or of the iterations is over that was left at the last scaling; in the last
phase the stage ends with its time.

* The budget is that of the whole method. A stage has a share of it, in proportion to what its
  protocol calls ``iterations``, among the stages that are learned.
* The clock is the one of :class:`~devrf.callbacks.TrainingRecord`: it starts with the stage's
  setup and stops for validation. The scene has been read by then; scores come later.
* Batches are whole where the schedule's iterations fit then, else halved, to a quarter: more
  iterations learn more than larger ones; except for a stage that ``keeps_batches``. Where not even
  ``ENOUGH_ITERATIONS`` fit, nor a quarter of the schedule's, they are halved further, as long as
  that saves time.
* Of several processes rank 0's clock decides.
* A progress file holds the seconds so far, the factor and what was measured: a run that was
  interrupted goes on with the time that is left. What it learns then is not bit for bit what it
  would have learned.
"""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.training_record import TrainingRecord
from devrf.engine.schedule import (
    Phase,
    cost,
    phases,
    same_place,
    scale_schedule,
    unscaled,
)
from devrf.engine.stage import Stage
from devrf.errors import DevrfError, expect
from devrf.system.device import wait
from devrf.system.options import Positive
from devrf.system.plain_data import validate

log = logging.getLogger(__name__)

# The most of the budget that a Lightning step may take.
STEP_SHARE = 0.01
# Shares of the schedule's batches, of which one is chosen.
BATCHES = tuple(2.0**-k for k in range(9))
# Shares that the trial draws, each for TRIAL_SHARE of the budget at most.
TRIED = (1 / 32, 1 / 4)
TRIAL_SHARE = 0.02
# For want of time batches are no smaller than this, unless fewer than ENOUGH_ITERATIONS would fit.
LEAST_BATCH = 1 / 4
ENOUGH_ITERATIONS = 100
# How much of an average the latest measurement is.
LATEST = 0.3


class Pace(NamedTuple):
    """Seconds for a unit of the phases' cost: ``fixed``, and ``of_batch`` in proportion to rays."""

    fixed: float
    of_batch: float

    def at(self, share: float) -> float:
        """Seconds with ``share`` of the rays."""
        return self.fixed + self.of_batch * share


class TimeBudget(Callback):
    """Has a stage end its schedule when its share of ``seconds`` is over.

    It sets the stage's ``iterations_per_step`` and ``batch_size``, scales its schedule, and moves
    its position to the end when the time is over.

    It needs a :class:`~devrf.callbacks.TrainingRecord` among the trainer's callbacks, and a place
    behind :class:`~devrf.callbacks.GridUpscaling`.

    Attributes:
        seconds: for all stages of the method together; None: the schedule's iterations.
        largest_batch: the most of the schedule's batches that is drawn.
    """

    def __init__(self, seconds: Positive | None = None, largest_batch: float = 1.0) -> None:
        """Prepare to count.

        Args:
            seconds: for all stages of the method together; None: the schedule's iterations.
            largest_batch: the most of the schedule's batches that is drawn within them.
        """
        expected = "more than 0, or null"
        expect(seconds is None or 0 < seconds < math.inf, "schedule.seconds", expected, seconds)
        key = "callbacks.time_budget.largest_batch"
        expect(0 < largest_batch <= 1, key, "in (0, 1]", largest_batch)
        self.seconds = seconds
        self.largest_batch = largest_batch
        self._forget()

    def _forget(self) -> None:
        self._pace: Pace | None = None
        self._entering: dict[str, float] = {}  # seconds to enter a phase of a kind

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        """The measurements."""
        pace = None if self._pace is None else list(self._pace)
        return {"pace": pace, "entering": dict(self._entering)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave, without a trial."""
        if state_dict["pace"] is not None:
            self._pace = Pace(*validate(tuple[float, float], state_dict["pace"]))
        self._entering = validate(dict[str, float], state_dict["entering"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin the trial."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage)
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        records = [other for other in callbacks if isinstance(other, TrainingRecord)]
        if not records:
            raise DevrfError(
                "TimeBudget: add devrf.callbacks.TrainingRecord, its clock, to the trainer's "
                "callbacks"
            )
        self._record = records[0]
        self._budget = self.seconds * pl_module.time_share
        self._phases = phases(unscaled(pl_module))
        self._phase = pl_module.phase
        self._most_iterations = pl_module.iterations_per_step
        pl_module.iterations_per_step = 1  # whose time is not known yet
        batch = pl_module.batch_size
        batch.smallest, batch.is_timed = BATCHES[-1], True
        most = min(self.largest_batch, batch.largest)
        self._tried: dict[float, list[float]] = {
            min(most, max(share, pl_module.useful_share)): [] for share in TRIED
        }
        if self._pace is None:
            batch.share = min(self._tried)
        self._is_due = self._pace is not None  # of a run that goes on
        self._is_new_kind = False  # of a phase whose iterations were not measured yet
        # Seconds and iteration at which the schedule is scaled again.
        self._next, self._next_iteration = 0.0, 0
        self._step_ended = self._record.seconds

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Scale the schedule to the time that is left, if that is due."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage) and pl_module.phase is not None
        wait(pl_module.device)
        now = self._record.seconds
        phase = pl_module.phase
        entered = phase != self._phase
        if entered:
            seconds = now - self._step_ended
            mean = self._entering.get(phase.kind, seconds)
            self._entering[phase.kind] = mean + LATEST * (seconds - mean)
        if self._is_due:
            self._scale(trainer, pl_module)
        if entered and self._phase is not None and phase.kind != self._phase.kind:
            self._is_new_kind = True
        self._phase = pl_module.phase
        self._done = pl_module.position.iterations_done
        self._step_share = pl_module.batch_size.share
        self._step_began = self._record.seconds

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Measure the step; end the trial, or with the time the stage."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage) and self._phase is not None
        wait(pl_module.device)
        self._step_ended = self._record.seconds
        done = pl_module.position.iterations_done - self._done
        share = pl_module.batch_size.share
        if done <= 0 or share != self._step_share:  # memory ran out
            self._tried = {min(tried, share): [] for tried in self._tried}
        else:
            seconds = self._step_ended - self._step_began
            pace = seconds / (done * self._phase.cost)
            if self._pace is None:
                self._try(trainer, pl_module, pace)
            else:
                ratio = pace / self._pace.at(share)
                if not self._is_new_kind:
                    ratio = 1 + LATEST * (ratio - 1)
                self._pace = Pace(self._pace.fixed * ratio, self._pace.of_batch * ratio)
        schedule = pl_module.schedule
        over = self._step_ended >= self._budget and self._phase.stop >= schedule.total
        # Iterations that have become faster reach a quarter of theirs first.
        passed = self._step_ended >= self._next
        passed |= pl_module.position.iteration >= self._next_iteration
        is_due = self._pace is not None and (self._is_new_kind or passed)
        over, self._is_due = trainer.strategy.broadcast((over, is_due))
        if over:
            pl_module.position.iteration = schedule.total
            trainer.should_stop = True

    def _try(self, trainer: Trainer, stage: Stage, pace: float) -> None:
        """Note the pace of a step of the trial; then larger batches, or the schedule is scaled."""
        assert stage.phase is not None
        share = stage.batch_size.share
        self._tried[share].append(pace)
        measured = self._tried[share][1:]  # the first step warms up
        most = TRIAL_SHARE * self._budget / stage.phase.cost
        ends = len(self._tried[share]) * pace > most
        if trainer.strategy.broadcast(not (ends and measured) and len(measured) < 10):
            return
        larger = [other for other in self._tried if other > share]
        long = measured and measured[-1] > most
        if trainer.strategy.broadcast(bool(larger) and not long):
            stage.batch_size.share = min(larger)
            return
        means = {s: sum(p[1:]) / len(p[1:]) for s, p in self._tried.items() if len(p) > 1}
        (first, slow), (last, quick) = min(means.items()), max(means.items())
        of_batch = max((quick - slow) / (last - first), 0.0) if last > first else slow / first
        self._pace = Pace(max(slow - of_batch * first, 0.0), of_batch)
        self._scale(trainer, stage, first=True)

    def _scale(self, trainer: Trainer, stage: Stage, *, first: bool = False) -> None:
        """Scale the schedule to the time that is left; ``first``: as the trial has just ended.

        Raises:
            DevrfError: one iteration of each phase takes longer.
        """
        scaling = trainer.strategy.broadcast(self._scaling(stage, first))
        if isinstance(scaling, str):
            raise DevrfError(scaling)
        factor, stage.batch_size.share, stage.iterations_per_step = scaling
        scale_schedule(stage, factor)
        now = self._record.seconds
        self._next = now + max((self._budget - now) / 4, STEP_SHARE * self._budget)
        place = stage.position.iteration
        self._next_iteration = place + max((stage.schedule.total - place) // 4, 1)
        self._is_new_kind = False

    def _scaling(self, stage: Stage, first: bool) -> tuple[float, float, int] | str:
        """Factor of the schedule, share of batches, iterations of a step; or why nothing fits."""
        assert self._pace is not None and stage.phase is not None
        configured = unscaled(stage)
        place = same_place(stage.position.iteration, stage.schedule, configured)
        later = [phase for phase in self._phases if phase.start > place]
        entering = self._to_enter(later)
        left = max(self._budget - self._record.seconds - entering, 1e-6 * self._budget)
        units = max(cost(configured, place, configured.total), 1e-9)
        share = stage.batch_size.share
        if first or self._is_new_kind:
            share = self._share_of_batches(stage, iterations=left / units * configured.total)
        if first:  # a run that goes on has been let pass before
            least = entering + self._pace.at(share) * sum(phase.cost for phase in later)
            if later and least > self._budget - self._record.seconds:
                return self._too_short(stage, self._record.seconds + least)
        pace = self._pace.at(share)
        iterations = int(STEP_SHARE * self._budget / (pace * stage.phase.cost))
        return left / (pace * units), share, min(max(iterations, 1), self._most_iterations)

    def _share_of_batches(self, stage: Stage, iterations: float) -> float:
        """The part of the schedule's batches to draw.

        ``iterations`` are those that are left if a unit of cost took a second.
        """
        assert self._pace is not None
        total = unscaled(stage).total
        least = 1.0 if stage.keeps_batches else LEAST_BATCH
        most = min(self.largest_batch, stage.batch_size.largest)
        for share in (part for part in BATCHES if part >= stage.useful_share):
            pace = self._pace.at(share)
            tight = iterations / pace < total and share > least
            few = iterations / pace < min(ENOUGH_ITERATIONS, total / 4)
            if not tight and not (few and pace > 2 * self._pace.fixed):
                break
        return min(share, most)

    def _to_enter(self, later: list[Phase]) -> float:
        """Seconds to enter phases; of a kind that was not entered yet, as of the slowest kind."""
        longest = max(self._entering.values(), default=0.0)
        return sum(self._entering.get(phase.kind, longest) for phase in later)

    def _too_short(self, stage: Stage, least: float) -> str:
        assert self.seconds is not None
        needed = 1.2 * least / stage.time_share
        digits = max(0, 1 - math.floor(math.log10(needed)))
        return (
            f"schedule.seconds: {self.seconds:g} is too little: {self._budget:.3g} s of it are the "
            f"{stage.name} stage's, whose {len(self._phases)} phases of one iteration each take "
            f"about {least:.3g} s on this machine; give {needed:.{digits}f} or more"
        )

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what the time was enough for."""
        if self.seconds is None or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, Stage)
        log.info(
            "%s: %d iterations for its %d, on %.3g%% of their rays, in %.1f s of %.1f",
            pl_module.name,
            pl_module.position.iterations_done,
            unscaled(pl_module).total,
            100 * pl_module.batch_size.share,
            self._record.seconds,
            self._budget,
        )

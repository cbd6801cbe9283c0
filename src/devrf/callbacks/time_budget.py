"""Fits a stage's schedule to a budget of wall time: ``schedule.seconds=N``.

The schedule stays as it is. ``stage.iteration`` is the place in it, and all that follows from a
place (levels, growths, decays, curricula) follows as before. What a budget changes is the
*stride*, how far an optimiser iteration goes in the schedule: with a stride of 3 a visit of 18
iterations takes 6, with one of 0.5 it takes 36. Every phase keeps one iteration at least. The
stage itself always goes one further; this callback adds the rest of the stride.

* The budget is that of the whole method. A stage has a share of it, in proportion to what its
  protocol calls ``iterations``, among the stages that are learned.
* The clock is the one of :class:`~devrf.callbacks.TrainingRecord`: it starts with the stage's
  setup and stops for previews. The scene has been read by then; scores come later.
* Before each Lightning step the stride is fitted anew, since the cost of iterations changes from
  level to level and is not known beforehand:

  stride = pace · (cost of the schedule that is left) / (seconds left − seconds to enter phases)

  ``pace`` is measured, in seconds for a unit of cost, and so is what it takes to enter a phase
  (grids that grow, a frame's occupancy and pixels). What an iteration of a phase costs beside one
  of another is the stage's own estimate (:meth:`~devrf.engine.stage.Stage.cost`): where it is
  wrong, levels get other shares of the time, but the end is where it should be.
* Where the stride would be more than 1, ``stage.batch_share`` is halved first, to a quarter: more
  iterations learn more than larger ones; except for a stage that ``keeps_batches``. Where not even
  ``ENOUGH_ITERATIONS`` fit, nor a quarter of the schedule's, it is halved further, as long as that
  saves time. It begins with ``FIRST_BATCH``, since nobody knows yet what an iteration takes; what
  its rays take of that is learned from each change, and batches grow where twice the schedule's
  iterations still fit, or, if they are to be kept, enough.
* Where an iteration for each phase takes longer than there is time, the finest are left out: levels
  of motion, growths of grids. Resolution follows the budget.
* Of several processes rank 0's clock decides.
* A progress file holds the seconds so far: a run that was interrupted goes on with those left. What
  it learns then is not bit for bit what it would have learned: a clock never gives the same twice.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

from lightning import Callback, LightningModule, Trainer
from torch.optim import Optimizer

from devrf.callbacks.training_record import TrainingRecord
from devrf.engine.phase import Phase
from devrf.engine.stage import Stage
from devrf.errors import DevrfError, expect
from devrf.system.device import wait

log = logging.getLogger(__name__)

# The most of the budget that a Lightning step may take, within which the stride is the same.
STEP_SHARE = 0.01
# The share of the budget after which it is checked that the rest suffices. Where it does not even
# for the coarsest grids, the stage is refused then; later what is finest is left out, no more.
TRIAL_SHARE = 0.25
# The parts of the schedule's batches of which one is drawn; the first, before anything is measured;
# the least for want of time; smaller ones where fewer iterations than enough would fit.
BATCHES = tuple(2.0**-k for k in range(9))
FIRST_BATCH = 1 / 64
LEAST_BATCH = 1 / 4
ENOUGH_ITERATIONS = 100
# Batches grow only where so many times the schedule's iterations, or enough of them, still fit.
MARGIN = 2.0
# Added to the last strides, whose sum would else fall short of the end.
ROUNDING = 1e-6
# How much of an average the latest measurement is.
LATEST = 0.3


def running_mean(mean: float | None, value: float) -> float:
    """``mean`` with a further ``value``; alone where there is none."""
    return value if mean is None else mean + LATEST * (value - mean)


def phases_of(stage: Stage) -> list[Phase]:
    """All phases of a stage that has been set up, in their order."""
    phases: list[Phase] = []
    place = 0
    while place < stage.total_iterations:
        phases.append(stage.phase_at(place))
        place = phases[-1].stop
    return phases


class TimeBudget(Callback):
    """Has a stage end its schedule when its share of ``seconds`` is over.

    It needs a :class:`~devrf.callbacks.TrainingRecord` among the trainer's callbacks, and a place
    behind :class:`~devrf.callbacks.GridUpscaling` and :class:`~devrf.callbacks.LearningRateDecay`.

    Attributes:
        seconds: for all stages of the method together; None: the schedule's iterations.
        largest_batch: the most of the schedule's batches that is drawn.
        stride: how far an optimiser iteration goes in the schedule.
    """

    def __init__(self, seconds: float | None = None, largest_batch: float = 1.0) -> None:
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
        self._pace: float | None = None  # seconds for a unit of cost
        self._besides = 0.0  # of these, what is not for rays
        self._before: tuple[float, float] | None = None  # share and pace, when the share changed
        self._share = 1.0  # with which the present step began
        self._entering: dict[str, float] = {}  # seconds to enter a phase of a kind
        self._warm = self._checked = False
        self._step_began = 0.0
        self._step_ended = 0.0
        self._done = 0
        self._most_iterations = 1
        self.stride = 1.0
        self._ahead = 0.0  # of ``stage.iteration``: where the strides have led
        self._phase: Phase | None = None
        self._phases: list[Phase] = []
        self._end = 0  # the place in the schedule where the stage ends

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Look at the schedule and the clock."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage)
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        self._record = next(other for other in callbacks if isinstance(other, TrainingRecord))
        self._phases = phases_of(pl_module)
        self._end = pl_module.total_iterations
        self._phase = pl_module.phase
        self._budget = self.seconds * pl_module.time_share
        self._most_iterations = pl_module.iterations_per_step
        pl_module.iterations_per_step = 1  # whose time is not known yet
        pl_module.smallest_share = BATCHES[-1]
        pl_module.batch_share = min(pl_module.batch_share, self.largest_batch)
        self._step_ended = self._record.seconds

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Fit the stride of the coming step, and its number of iterations."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage)
        wait(pl_module.device)
        self._step_began = self._record.seconds
        self._done = pl_module.iterations_done
        phase = pl_module.phase
        if phase is not None and phase != self._phase:
            entering = running_mean(
                self._entering.get(phase.kind), self._step_began - self._step_ended
            )
            self._phase = phase
            self._entering[phase.kind] = entering
        if self._pace is None and not pl_module.iterations_done:
            # Only now: what has been entered before is not made smaller for want of time.
            first = max(FIRST_BATCH, pl_module.useful_share)
            pl_module.batch_share = min(pl_module.batch_share, first)
        if self._pace is not None:
            fitted = trainer.strategy.broadcast(self._fitted(pl_module))
            if isinstance(fitted, str):
                raise DevrfError(fitted)
            self.stride, pl_module.iterations_per_step, share, self._end = fitted
            if share != pl_module.batch_share:  # an iteration's time is measured anew
                self._before = (pl_module.batch_share, self._pace)
                self._pace = self._pace_with(pl_module, share)
                self._warm = False
                pl_module.batch_share = share
        self._share = pl_module.batch_share

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Move the stage in its schedule by the stride less the one iteration that it adds itself.

        It stays within its phase; what is left of the stride is made up for in the next.
        """
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage) and pl_module.phase is not None
        place = pl_module.iteration + self._ahead + self.stride
        following = min(math.floor(place), pl_module.phase.stop)
        self._ahead = min(place - following, max(self.stride, 1.0))
        ends = following >= self._end
        pl_module.iteration = (pl_module.total_iterations if ends else following) - 1

    def _fitted(self, stage: Stage) -> tuple[float, int, float, int] | str:
        """Stride, iterations, share of batches, and the end; or why the budget is too short."""
        assert self._pace is not None and stage.phase is not None
        pace = self._pace
        left = self._budget - self._step_began
        later = [phase for phase in self._phases if phase.start > stage.iteration]
        # The first iteration is slow, and says little unless it has taken all the time.
        tried = self._step_began >= TRIAL_SHARE * self._budget and (self._warm or left < 0)
        if tried and self._least(later) > left:
            if not self._leave_out(stage, left) and not self._checked:
                return self._too_short(stage, self._step_began + self._least(later))
            later = [phase for phase in later if phase in self._phases]
        self._checked |= tried
        entering = self._to_enter(later)
        place = stage.iteration + self._ahead
        whole = pace * sum(
            phase.cost * max(0.0, phase.stop - max(phase.start, place))
            for phase in (stage.phase, *later)
        )
        # Out of time, what is left gets an iteration a phase.
        stride = whole / (left - entering) if left > entering else float(stage.total_iterations)
        share = self._share_of_batches(stage, stride)
        pace = self._pace_with(stage, share)
        stride *= pace / self._pace
        if not later:  # whole iterations are left: as many as end nearest to the budget
            iterations = max(1, round(left / (pace * stage.phase.cost)))
            stride = (stage.phase.stop - place) / iterations + ROUNDING
        most = STEP_SHARE * self._budget / (pace * stage.phase.cost)
        iterations = max(1, min(self._most_iterations, int(most)))
        return stride, iterations, share, self._phases[-1].stop

    def _share_of_batches(self, stage: Stage, stride: float) -> float:
        """The part of the schedule's batches to draw; ``stride`` is that with the present one.

        The largest with which the stride is 1 at most, or else ``LEAST_BATCH``, all of a stage that
        keeps its batches; with which enough iterations fit, or its rays take no longer than what an
        iteration does besides.
        """
        assert self._pace is not None
        present = stage.batch_share
        allowed = min(self.largest_batch, stage.largest_share)
        if stride <= 0:
            return min(present, allowed)
        most = allowed if self._warm else present
        least = 1.0 if stage.keeps_batches else LEAST_BATCH
        margin = 1.0 if stage.keeps_batches else MARGIN
        enough = min(ENOUGH_ITERATIONS, self._end / 4) * (1 - stage.iteration / self._end)
        iterations = (self._end - stage.iteration) / stride  # in the time that is left
        for share in (part for part in BATCHES if part >= stage.useful_share):
            pace = self._pace_with(stage, share)
            longer = pace / self._pace * (1.0 if share <= present else margin)
            tight = longer * stride > 1 and share > least
            few = iterations < longer * enough and pace > 2 * self._besides
            if share <= most and not (tight or few):
                break
        return min(share, allowed)

    def _pace_with(self, stage: Stage, share: float) -> float:
        """Seconds for a unit of cost, with ``share`` of the batches."""
        assert self._pace is not None
        besides = min(self._besides, self._pace)
        return besides + (self._pace - besides) * share / stage.batch_share

    def _learn_what_rays_take(self, pace: float) -> None:
        """From the paces of two shares: what of an iteration does not depend on its rays."""
        if self._before is not None:
            other, before = self._before
            by_rays = max((pace - before) / (self._share - other), 0.0)
            self._besides = max(min(pace, before) - by_rays * min(self._share, other), 0.0)
        self._before = None

    def _to_enter(self, phases: Sequence[Phase]) -> float:
        """Seconds: where no phase of the kind has been entered yet, as long as of another kind.

        Where none has been at all, as long as an iteration.
        """
        assert self._pace is not None
        longest = max(self._entering.values(), default=0.0)
        usual = {one.kind: max(longest, self._pace * one.cost) for one in phases}
        return sum((usual | self._entering)[one.kind] for one in phases)

    def _least(self, phases: Sequence[Phase]) -> float:
        """Seconds of one iteration each, with what it takes to enter them."""
        assert self._pace is not None
        return self._to_enter(phases) + self._pace * sum(phase.cost for phase in phases)

    def _leave_out(self, stage: Stage, left: float) -> bool:
        """Leave out the finest grids' phases, so that the others fit; whether any do."""
        for count in range(len(self._phases) - 1, 0, -1):
            last = self._phases[count - 1]
            following = self._phases[count]
            # A level of all frames, or none of it; and no field before its search has ended.
            between = last.frame is None or last.kind != following.kind
            ahead = following.start > stage.iteration and last.kind != "search"
            if not (between and ahead):
                continue
            if self._least([p for p in self._phases[:count] if p.start > stage.iteration]) <= left:
                log.info(
                    "%s: schedule.seconds=%g is too little for its finest grids: it ends with %s, "
                    "after %d of %d phases",
                    stage.name,
                    self.seconds,
                    last.kind,
                    count,
                    len(self._phases),
                )
                self._phases = self._phases[:count]
                return True
        return False

    def _too_short(self, stage: Stage, least: float) -> str:
        assert self.seconds is not None
        needed = 1.2 * least / stage.time_share
        digits = max(0, 1 - math.floor(math.log10(needed)))
        return (
            f"schedule.seconds: {self.seconds:g} is too little: {self._budget:.3g} s of it are the "
            f"{stage.name} stage's, whose {len(self._phases)} phases of one iteration each take "
            f"about {least:.3g} s on this machine; give {needed:.{digits}f} or more"
        )

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Measure the step."""
        if self.seconds is None:
            return
        assert isinstance(pl_module, Stage) and self._phase is not None
        wait(pl_module.device)
        self._step_ended = self._record.seconds
        done = pl_module.iterations_done - self._done
        if done > 0:  # none, if memory ran out
            pace = (self._step_ended - self._step_began) / (done * self._phase.cost)
            if pl_module.batch_share == self._share:
                self._learn_what_rays_take(pace)
            else:  # memory ran out, and fewer rays were drawn
                self._before = None
                self._warm = False
            # The first step warms up.
            self._pace = running_mean(self._pace if self._warm else None, pace)
            self._warm = self._warm or pl_module.iterations_done > done

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what the time was enough for."""
        if self.seconds is None or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, Stage)
        log.info(
            "%s: %d iterations for its %d, on %.3g%% of their rays, in %.1f s of %.1f",
            pl_module.name,
            pl_module.iterations_done,
            pl_module.iteration,
            100 * pl_module.batch_share,
            self._record.seconds,
            self._budget,
        )

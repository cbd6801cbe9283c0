"""A schedule that is fitted to seconds, by a clock on which every iteration takes what is said."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from itertools import count
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback

from devrf.callbacks import TimeBudget, TrainingRecord
from devrf.engine.grid_adam import GridAdam
from devrf.engine.stage import Stage, Terms
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import (
    DeformationPhase,
    DeformationSchedule,
    Level,
    Visits,
)

# Three frames: frames 1 and 2 are visited at each level, frame 1 for two shares.
SCHEDULE = DeformationSchedule(levels=(Level(4, 30), Level(6, 10)), rays=16)
VISITS = Visits(SCHEDULE, frames=3)
# Seconds to enter a visit, and for an iteration of each level: 90 of the first, 30 of the second.
ENTER, ITERATION = 0.1, {0: 0.02, 1: 0.06}
WHOLE = 4 * ENTER + 90 * 0.02 + 30 * 0.06


class Clocked(Stage):
    """Learns nothing, by the schedule of a deformation stage; its clock says how long it takes.

    Attributes:
        now: seconds.
        drawn: the rays of each batch.
        visits: iterations by level and frame.
    """

    name = "clocked"
    capture = "dynamic"

    def __init__(
        self,
        by_batch: Callable[[float], float] = lambda share: 1.0,
        memory: float = math.inf,
        **attributes: Any,
    ) -> None:
        super().__init__(iterations_per_step=10)
        self.schedule = VISITS
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.optimizer = GridAdam([{"params": [self.weight], "lr": 1.0, "base_lr": 1.0}])
        self.by_batch, self.memory = by_batch, memory
        self.now, self.drawn, self.visits = 0.0, [], Counter[tuple[int, int]]()
        for name, value in attributes.items():
            setattr(self, name, value)

    def enter(self, phase: DeformationPhase) -> None:
        self.phase = phase
        self.now += ENTER

    def restore(self, phase: DeformationPhase, state: Any) -> None:
        raise NotImplementedError

    def iterate(self, views: Any) -> Terms:
        self.drawn.append(self.batch_size.rays(SCHEDULE.rays))
        if self.drawn[-1] > self.memory:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        self.optimise(loss := self.weight.square().sum())
        self.now += ITERATION[self.phase.level] * self.by_batch(self.batch_size.share)
        self.visits[self.phase.level, self.phase.frame] += 1
        return {"loss": loss.detach()}


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch, fit) -> Callable[..., Clocked]:
    """``timed(seconds)``: the stage, fitted within a budget, by its own clock."""

    def learn(seconds: float | None, largest_batch: float = 1.0, **options: Any) -> Clocked:
        stage = Clocked(**options)
        monkeypatch.setattr(TrainingRecord, "seconds", property(lambda self: stage.now))
        fit(stage, TimeBudget(seconds, largest_batch), TrainingRecord())
        return stage

    return learn


@pytest.mark.parametrize("share", [0.4, 3.0])
def test_a_stage_ends_with_its_seconds_and_its_whole_schedule(timed, share: float) -> None:
    stage = timed(2 * share * WHOLE, time_share=0.5)
    assert stage.now == pytest.approx(share * WHOLE, rel=0.1)
    visits = stage.visits
    assert stage.is_complete
    assert stage.provenance.record["iterations"] == visits.total() == stage.position.iterations_done
    assert list(visits) == [(0, 1), (0, 2), (1, 1), (1, 2)]
    assert visits[0, 1] == pytest.approx(2 * visits[0, 2], rel=0.35)
    assert stage.schedule == VISITS.scaled(stage.position.schedule_scale)
    assert stage.optimizer.param_groups[0]["lr"] == pytest.approx(10**-0.25)


@pytest.mark.parametrize("later", [0.02, 0.5, 3.0])
def test_iterations_that_become_faster_or_slower_do_not_change_the_end(timed, later: float) -> None:
    # As those of a field in which nothing is known to be empty at first. No kind of phase comes
    # after the first.
    number = count()
    schedule = Visits(DeformationSchedule(levels=(Level(4, 100),), rays=16), frames=2)
    stage = timed(2.0, by_batch=lambda _: 1.0 if next(number) < 20 else later, schedule=schedule)
    assert stage.now == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(("share", "rays"), [(0.4, 4), (2.5, 16)])
def test_batches_are_quartered_before_iterations_are_left_out(
    timed, share: float, rays: int
) -> None:
    stage = timed(share * WHOLE, by_batch=lambda part: part)
    assert stage.now == pytest.approx(share * WHOLE, rel=0.1)
    assert stage.batch_size.rays(SCHEDULE.rays) == rays


def test_batches_that_are_to_be_kept_are(timed) -> None:
    stage = timed(0.7 * WHOLE, by_batch=lambda part: part, keeps_batches=True)
    assert stage.now == pytest.approx(0.7 * WHOLE, rel=0.1)
    assert stage.batch_size.share == 1


def test_no_batch_is_smaller_than_saves_time(timed) -> None:
    stage = timed(2.0, by_batch=lambda part: 5 * max(part, 1 / 4), useful_share=1 / 4)
    assert min(stage.drawn) == SCHEDULE.rays / 4


def test_iterations_that_take_all_the_time_are_made_of_fewer_rays_still(timed) -> None:
    # In a quarter of their rays six iterations would fit.
    stage = timed(0.7, by_batch=lambda part: 5 * part)
    assert stage.now == pytest.approx(0.7, rel=0.1)
    assert stage.batch_size.share < 1 / 4 and stage.visits.total() >= 20


def test_batches_are_not_made_smaller_where_that_saves_no_time(timed) -> None:
    stage = timed(1.4, by_batch=lambda part: 1 + part)
    assert stage.now == pytest.approx(1.4, rel=0.12)
    assert stage.batch_size.share >= 1 / 16


def test_batches_are_no_larger_than_there_is_memory_for(timed, caplog) -> None:
    caplog.set_level("INFO")
    stage = timed(WHOLE, largest_batch=1 / 8)
    assert stage.batch_size.share == 1 / 8 and "on 12.5% of their rays" in caplog.text
    assert timed(WHOLE / 2, largest_batch=1 / 1000).batch_size.share == 1 / 1000
    with pytest.raises(DevrfError, match=r"largest_batch: expected in \(0, 1\], not 2"):
        TimeBudget(0.5, largest_batch=2)


def test_memory_that_runs_out_as_batches_grow_ends_their_growth(timed) -> None:
    stage = timed(2.5 * WHOLE, memory=SCHEDULE.rays / 4)
    assert stage.batch_size.share == 1 / 4
    assert [rays for rays in stage.drawn if rays > 4] == [16, 8]
    assert stage.is_complete


def test_too_little_time_is_refused_and_none_changes_nothing(timed) -> None:
    stage = timed(None)
    assert stage.now == pytest.approx(WHOLE)
    assert stage.position.iterations_done == stage.position.iteration
    assert dict(stage.visits) == {(0, 1): 60, (0, 2): 30, (1, 1): 20, (1, 2): 10}
    for seconds in (0.4, 0.1):  # four visits are entered in 0.4 s
        with pytest.raises(DevrfError, match=rf"seconds: {seconds} is too little: .* 4 phases"):
            timed(seconds)
    with pytest.raises(DevrfError, match=r"schedule.seconds: expected more than 0, or null, not 0"):
        TimeBudget(0)


def test_a_run_that_goes_on_makes_no_trial_and_is_not_refused(fit) -> None:
    first = TimeBudget(1.0)
    first.load_state_dict({"pace": [0.01, 0.02], "entering": {"level 1": 0.5}})
    state = first.state_dict()
    again = TimeBudget(1.0)
    again.load_state_dict(state)
    assert again.state_dict() == state
    # Its visits would take longer to enter than there is time: they get an iteration each.
    stage = Clocked()
    load = LambdaCallback(setup=lambda trainer, module, stage: again.load_state_dict(state))
    fit(stage, again, load, TrainingRecord())
    assert stage.is_complete and stage.drawn[0] == SCHEDULE.rays


def test_a_budget_without_a_clock_is_one_line(fit) -> None:
    with pytest.raises(DevrfError, match="add devrf.callbacks.TrainingRecord, its clock"):
        fit(Clocked(), TimeBudget(1.0))

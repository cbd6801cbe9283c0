"""A schedule that is fitted to seconds, by a clock on which every iteration takes what is said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback

from devrf.callbacks import TimeBudget, TrainingRecord
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage

# Three frames: frames 1 and 2 are visited at each level, frame 1 for two shares.
SCHEDULE = DeformationSchedule(levels=(Level(4, 60), Level(6, 20)), rays=16)
# Seconds to enter a visit, and for an iteration of each level: 180 of the first, 60 of the second.
ENTER, ITERATION = 0.1, {0: 0.01, 1: 0.03}
WHOLE = 4 * ENTER + 180 * 0.01 + 60 * 0.03


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch, fit, rest: LoadedCheckpoint) -> Callable[..., Any]:
    """``timed(seconds)``: the fitted stage, its seconds, and the iterations of each visit."""

    def learn(
        seconds: float | None,
        time_share: float = 1.0,
        by_batch: Callable[[float], float] = lambda share: 1.0,
        largest_batch: float = 1.0,
    ) -> tuple[Any, float, Counter]:
        stage, now, visits = DeformationStage(rest, SCHEDULE), [0.0], Counter()
        stage.time_share, enter = time_share, stage.enter

        def slowly(phase: Any) -> None:
            enter(phase)
            now[0] += ENTER

        def tick(trainer: Any, stage: Any, optimizer: Any) -> None:
            now[0] += ITERATION[stage.phase.level] * by_batch(stage.batch_size.share)
            visits[stage.phase.level, stage.phase.frame] += 1

        stage.enter = slowly
        monkeypatch.setattr(TrainingRecord, "seconds", property(lambda self: now[0]))
        watch = LambdaCallback(on_before_optimizer_step=tick)
        budget = TimeBudget(seconds, largest_batch)
        return fit(stage, budget, watch, TrainingRecord()), now[0], visits

    return learn


@pytest.mark.parametrize("share", [0.4, 3.0])
def test_a_stage_ends_with_its_seconds_and_its_whole_schedule(timed, share: float) -> None:
    stage, seconds, visits = timed(2 * share * WHOLE, time_share=0.5)
    assert seconds == pytest.approx(share * WHOLE, rel=0.1)
    assert stage.is_complete and stage.resolution[0] > 4
    assert stage.provenance.record["iterations"] == visits.total() == stage.position.iterations_done
    assert list(visits) == [(0, 1), (0, 2), (1, 1), (1, 2)]
    assert visits[0, 1] == pytest.approx(2 * visits[0, 2], rel=0.35)
    assert stage.schedule == SCHEDULE.scaled(stage.position.schedule_scale)
    assert stage.optimizer.param_groups[0]["lr"] == pytest.approx(
        10**-0.25 * stage.optimizer.param_groups[0]["base_lr"]
    )


@pytest.mark.parametrize(("share", "rays"), [(0.4, 4), (2.5, 16)])
def test_batches_are_quartered_before_iterations_are_left_out(
    timed, share: float, rays: int
) -> None:
    stage, seconds, _ = timed(share * WHOLE, by_batch=lambda part: part)
    assert seconds == pytest.approx(share * WHOLE, rel=0.1)
    assert stage.batch_size.rays(SCHEDULE.rays) == rays


def test_batches_that_are_to_be_kept_are(timed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DeformationStage, "keeps_batches", True)
    stage, seconds, _ = timed(0.7 * WHOLE, by_batch=lambda part: part)
    assert seconds == pytest.approx(0.7 * WHOLE, rel=0.1)
    assert stage.batch_size.share == 1


def test_no_batch_is_smaller_than_saves_time(timed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DeformationStage, "useful_share", 1 / 4)
    drawn: set[float] = set()

    def by_batch(part: float) -> float:
        drawn.add(part)
        return 5 * max(part, 1 / 4)

    timed(2.0, by_batch=by_batch)
    assert min(drawn) == 1 / 4


def test_iterations_that_take_all_the_time_are_made_of_fewer_rays_still(timed) -> None:
    # In a quarter of their rays six iterations would fit.
    stage, seconds, visits = timed(0.7, by_batch=lambda part: 5 * part)
    assert seconds == pytest.approx(0.7, rel=0.1)
    assert stage.batch_size.share < 1 / 4 and visits.total() >= 20


def test_batches_are_not_made_smaller_where_that_saves_no_time(timed) -> None:
    stage, seconds, _ = timed(0.7, by_batch=lambda part: 1 + part)
    assert seconds == pytest.approx(0.7, rel=0.12)
    assert stage.batch_size.share >= 1 / 16


def test_batches_are_no_larger_than_there_is_memory_for(timed, caplog) -> None:
    caplog.set_level("INFO")
    stage, _, _ = timed(WHOLE, largest_batch=1 / 8)
    assert stage.batch_size.share == 1 / 8 and "on 12.5% of their rays" in caplog.text
    stage, _, _ = timed(WHOLE / 2, largest_batch=1 / 1000)
    assert stage.batch_size.share == 1 / 1000
    with pytest.raises(DevrfError, match=r"largest_batch: expected in \(0, 1\], not 2"):
        TimeBudget(0.5, largest_batch=2)


def test_memory_that_runs_out_as_batches_grow_ends_their_growth(timed, monkeypatch) -> None:
    usual = DeformationStage.draw
    drawn: list[int] = []

    def draw(stage: DeformationStage) -> Any:
        image, flat = usual(stage)
        drawn.append(len(image))
        if len(image) > SCHEDULE.rays / 4:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return image, flat

    monkeypatch.setattr(DeformationStage, "draw", draw)
    stage, _, _ = timed(2.5 * WHOLE)
    assert stage.batch_size.share == 1 / 4 and [rays for rays in drawn if rays > 4] == [16, 8]
    assert stage.is_complete


def test_too_little_time_is_refused_and_none_changes_nothing(timed) -> None:
    stage, seconds, visits = timed(None)
    assert (seconds, stage.position.iterations_done) == (pytest.approx(WHOLE), stage.iteration)
    assert dict(visits) == {(0, 1): 120, (0, 2): 60, (1, 1): 40, (1, 2): 20}
    for seconds in (0.4, 0.1):  # four visits are entered in 0.4 s
        with pytest.raises(DevrfError, match=rf"seconds: {seconds} is too little: .* 4 phases"):
            timed(seconds)
    with pytest.raises(DevrfError, match=r"schedule.seconds: expected more than 0, or null, not 0"):
        TimeBudget(0)


def test_a_run_that_goes_on_makes_no_trial_and_is_not_refused(fit, rest) -> None:
    first = TimeBudget(1.0)
    first.load_state_dict({"pace": [0.01, 0.02], "entering": {"level 1": 0.5}})
    state = first.state_dict()
    again = TimeBudget(1.0)
    again.load_state_dict(state)
    assert again.state_dict() == state
    # Its visits would take longer to enter than there is time: they get an iteration each.
    stage = DeformationStage(rest, SCHEDULE)
    shares: list[float] = []
    load = LambdaCallback(
        setup=lambda trainer, module, stage: again.load_state_dict(state),
        on_train_batch_end=lambda trainer, stage, *_: shares.append(stage.batch_size.share),
    )
    fit(stage, again, load, TrainingRecord())
    assert stage.is_complete and shares[0] == 1.0


def test_a_budget_without_a_clock_is_one_line(fit, rest) -> None:
    with pytest.raises(DevrfError, match="add devrf.callbacks.TrainingRecord, its clock"):
        fit(DeformationStage(rest, SCHEDULE), TimeBudget(1.0))

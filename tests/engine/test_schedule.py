"""Phases of a schedule: callbacks have made one ready, and a scaled schedule has as many."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from devrf.engine.position import Position
from devrf.engine.schedule import entered_phase, phases, scale_schedule, unscaled
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level, Visits
from devrf.methods.ray_schedule import RaySchedule

VISITS = Visits(DeformationSchedule([Level(4, 30), Level(6, 10)]), frames=3)
RAYS = RaySchedule(
    iterations=100,
    rays=8,
    learning_rate=1.0,
    final_learning_rate=0.1,
    growths=(20, 60),
    milestones={"all frames shown": 50},
)


def stage_at(iteration: int, schedule: Any = VISITS, **attributes: Any) -> Any:
    ready = {"phase": schedule.phase(iteration), "has_scheduled_rates": True}
    position = Position(iteration=iteration)
    known = {"schedule": schedule, "configured_schedule": None, "position": position}
    return SimpleNamespace(**{**known, **ready, **attributes})


def test_a_phase_that_callbacks_have_made_ready_is_the_iterations():
    assert entered_phase(stage_at(70)) == VISITS.phase(70)


@pytest.mark.parametrize("phase", [None, VISITS.phase(100)])
def test_a_phase_that_no_callback_entered_is_refused(phase):
    with pytest.raises(DevrfError, match="phase of iteration 70 was not entered: add .*Upscaling"):
        entered_phase(stage_at(70, phase=phase))


def test_learning_rates_that_no_callback_sets_are_refused():
    with pytest.raises(DevrfError, match="rates of its schedule are not set: add .*RateDecay"):
        entered_phase(stage_at(70, has_scheduled_rates=False))


@pytest.mark.parametrize("schedule", [VISITS, RAYS])
def test_a_scaled_schedule_has_the_same_phases_and_forgets_nothing(schedule):
    stage = stage_at(schedule.total // 2, schedule)
    for factor in (0.5, 0.1, 3.0):
        scale_schedule(stage, factor)
        kinds = [phase.kind for phase in phases(schedule)]
        assert [phase.kind for phase in phases(stage.schedule)] == kinds
        assert unscaled(stage) is schedule and stage.position.schedule_scale == factor
        assert stage.phase == stage.schedule.phase(stage.position.iteration)
    assert stage.schedule.total == 3 * schedule.total

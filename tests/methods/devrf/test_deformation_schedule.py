"""Schedules: the paper's tables, and what holds for every schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.deformation_schedule import (
    PAPER_LEVELS,
    DeformationPhase,
    DeformationSchedule,
    Level,
    Visits,
)
from devrf.methods.devrf.settings import VisitSettings


def with_level(number: int, **other: Any) -> list[Level]:
    """The paper's levels, one of them changed."""
    levels = list(PAPER_LEVELS)
    levels[number - 1] = replace(levels[number - 1], **other)
    return levels


def in_order(phase: Callable[[int], Any], total: int) -> list[Any]:
    """The phases in order, found as a stage finds them: each at the end of the one before."""
    phases, at = [], 0
    while at < total:
        phases.append(phase(at))
        assert phases[-1].stop > at
        at = phases[-1].stop
    return phases


def deformation_phases(schedule: DeformationSchedule, frames: int) -> list[DeformationPhase]:
    visits = Visits(schedule, frames)
    return in_order(visits.phase, visits.total)


def test_canonical_defaults_are_the_papers():
    schedule = CanonicalSchedule()
    assert schedule.total == 25000
    found = [(p.kind, p.start, p.stop, p.voxels) for p in in_order(schedule.phase, schedule.total)]
    full = 160**3
    assert found == [
        ("search", 0, 5000, 100**3),
        ("fine", 5000, 6000, full // 16),
        ("fine", 6000, 7000, full // 8),
        ("fine", 7000, 8000, full // 4),
        ("fine", 8000, 9000, full // 2),
        ("fine", 9000, 25000, full),
    ]
    assert schedule.rays == 8192


def test_canonical_rates_fall_to_a_tenth_in_each_part_or_begin_again_at_each_growth():
    factor = CanonicalSchedule(restart_at_growth=False).learning_rate_factor
    assert factor(0) == factor(5000) == 1.0
    assert factor(4999) == pytest.approx(0.1 ** (4999 / 20000))
    assert factor(15000) == pytest.approx(0.1**0.5)
    assert factor(25000) == pytest.approx(0.1)
    again = CanonicalSchedule().learning_rate_factor
    assert again(0) == again(5000) == again(6000) == again(9000) == 1.0
    assert again(8999) == pytest.approx(0.1 ** (999 / 20000))
    # The authors' last rate: 0.016, forward-facing 0.025.
    assert 0.1 * again(25000) == pytest.approx(0.0158, abs=1e-4)
    forward = CanonicalSchedule(search_iterations=0, upsample_at=(2000, 4000, 6000, 8000))
    assert 0.1 * forward.learning_rate_factor(20000) == pytest.approx(0.0251, abs=1e-4)


def test_deformation_defaults_are_the_papers_inward():
    schedule, frames = DeformationSchedule(), 50
    assert Visits(schedule, frames).total == 25000
    assert Visits(schedule, frames).level_starts == [10000, 15000, 20000, 22500]
    phases = deformation_phases(schedule, frames)
    assert len(phases) == 5 * 49
    assert [p.side for p in phases[::49]] == [10, 20, 40, 80, 160]
    for level, share in enumerate((200, 100, 100, 50, 50)):
        of_level = phases[49 * level : 49 * (level + 1)]
        # Frame 0 is the identity: its share goes to frame 1.
        assert [p.stop - p.start for p in of_level] == [2 * share] + [share] * 48
        for phase in of_level:
            assert phase.rate_factor == pytest.approx(10 ** (-level / 4))
    assert 1e-3 * phases[-1].rate_factor == pytest.approx(1e-4)
    assert schedule.rays == 8192


def test_forward_facing_and_without_coarse_to_fine():
    forward = DeformationSchedule(with_level(2, iterations=200), rays=4096)
    assert Visits(forward, 40).total == 24000
    assert Visits(forward, 40).level_starts == [8000, 16000, 20000, 22000]
    # Every share goes to the finest grid, where each frame starts from the one before it.
    schedule = DeformationSchedule(coarse_to_fine=False)
    phases = deformation_phases(schedule, 50)
    assert Visits(schedule, 50).total == 25000 and Visits(schedule, 50).level_starts == []
    assert {(p.side, p.level, p.rate_factor) for p in phases} == {(160, 0, 1.0)}
    assert [p.frame for p in phases] == list(range(1, 50))
    assert [p.init_from_previous for p in phases] == [False] + [True] * 48


def course(schedule: DeformationSchedule, frames: int) -> list[tuple[Any, ...]]:
    """Level, frame and iterations of each visit."""
    phases = deformation_phases(schedule, frames)
    return [(p.level, p.frame, p.start, p.stop) for p in phases]


def test_frames_are_visited_one_after_another():
    schedule = DeformationSchedule((Level(4, 6), Level(6, 4)))
    assert course(schedule, 4) == [
        (0, 1, 0, 12),
        (0, 2, 12, 18),
        (0, 3, 18, 24),
        (1, 1, 24, 32),
        (1, 2, 32, 36),
        (1, 3, 36, 40),
    ]
    assert Visits(schedule, 4).total == 40 and Visits(schedule, 4).level_starts == [24]
    phases = deformation_phases(schedule, 4)
    assert [p.init_from_previous for p in phases] == [False, True, True, False, False, False]


def test_a_level_may_go_through_the_frames_backwards():
    schedule = DeformationSchedule((Level(4, 6), Level(6, 4, backwards=True)))
    assert course(schedule, 4)[3:] == [(1, 3, 24, 32), (1, 2, 32, 36), (1, 1, 36, 40)]
    assert [p.step for p in deformation_phases(schedule, 4)] == [1, 1, 1, -1, -1, -1]
    # Without coarse to fine there is one level; it begins at rest, without a level's own factors.
    alone = replace(schedule, coarse_to_fine=False)
    assert [p.frame for p in deformation_phases(alone, 4)] == [1, 2, 3]
    finishing = Level(6, 4, lr_factor=0.1, lr_final_factor=0.1, other_terms=0.1)
    for last in (Level(6, 4), finishing):
        (level,) = DeformationSchedule((Level(4, 6), last), coarse_to_fine=False).levels
        assert level == Level(6, 10)


@given(
    st.lists(
        st.tuples(st.integers(2, 99), st.integers(1, 9), st.booleans()), min_size=1, max_size=5
    ),
    st.integers(2, 12),
    st.booleans(),
)
def test_deformation_phases_tile_every_schedule(levels, frames, coarse_to_fine):
    rows = [
        Level(side, iterations, backwards=level > 0 and backwards)
        for level, (side, iterations, backwards) in enumerate(levels)
    ]
    schedule = Visits(DeformationSchedule(rows, coarse_to_fine), frames)
    phases = deformation_phases(schedule.settings, frames)
    assert phases[0].start == 0 and phases[-1].stop == schedule.total
    for phase, after in zip(phases, phases[1:], strict=False):
        assert phase.stop == after.start
    for phase in phases:
        assert {schedule.phase(k) for k in range(phase.start, phase.stop)} == {phase}
    depth = len(levels) if coarse_to_fine else 1
    visits = [
        (level, frame)
        for level in range(depth)
        for frame in range(1, frames)[:: -1 if coarse_to_fine and rows[level].backwards else 1]
    ]
    assert [(p.level, p.frame) for p in phases] == visits
    begun = [[p.start for p in phases if p.level == level][0] for level in range(depth)]
    assert begun == [0, *schedule.level_starts]
    assert schedule.phase(schedule.total + 3) == phases[-1]


@pytest.mark.parametrize(
    ("build", "key"),
    [
        (lambda: CanonicalSchedule(upsample_at=(1000, 1000)), "canonical.upsample_at"),
        (lambda: CanonicalSchedule(side=2), "canonical.upsample_at"),  # 8 voxels, halved four times
        (lambda: CanonicalSchedule(rays=0), "canonical.rays"),
        (lambda: DeformationSchedule(levels=()), "deformation.levels: expected at least 1 item"),
        (
            lambda: DeformationSchedule(with_level(5, iterations=0)),
            "levels.iterations: expected at least 1",
        ),
        (
            lambda: DeformationSchedule(with_level(2, other_terms=-1)),
            "levels.other_terms: expected at least 0",
        ),
        (
            lambda: DeformationSchedule(with_level(1, backwards=True)),
            "levels.1.backwards: expected false",
        ),
    ],
)
def test_a_wrong_schedule_is_an_error(build, key):
    with pytest.raises(DevrfError, match=key):
        build()


def test_rows_of_a_config_are_levels_in_the_order_of_their_numbers():
    rows: dict[str, Any] = {
        "2": {"side": 6, "iterations": 4},
        "1": {"side": 4, "iterations": 6},
        "3": None,
    }
    schedule = DeformationSchedule.from_rows(rows, rays=64)
    assert schedule == DeformationSchedule([Level(4, 6), Level(6, 4)], rays=64)
    for wrong in ({"1": None}, {"2": {"side": 6}}, {"2": 5}):
        with pytest.raises(DevrfError, match="expected rows 1 to"):
            DeformationSchedule.from_rows({**rows, **wrong})


def test_a_level_may_have_a_rate_of_its_own():
    last = Level(8, 2, lr_factor=0.3, lr_final_factor=0.1)
    schedule = DeformationSchedule((Level(4, 2), Level(8, 2, lr_factor=0.5), last))
    phases = [Visits(schedule, 2).phase(i) for i in (0, 4, 8)]
    rates = [(p.rate_factor, p.lr_final_factor) for p in phases]
    assert rates == [(1, 1), (0.5, 1), (0.3, 0.1)]
    assert phases[2].learning_rate_at(phases[2].stop) == pytest.approx(0.03)


# The paper's, and one that has every event.
SCHEDULES = {
    "inward": CanonicalSchedule(),
    "forward": CanonicalSchedule(
        search_iterations=0,
        side=203.2,
        upsample_at=(2000, 4000, 6000, 8000),
        dense_tv_iterations=10_000,
        view_dependence_start=5000,
    ),
}


def test_events_of_the_papers_schedule():
    assert SCHEDULES["inward"].planned_events == {
        "geometry searched": 1,
        "grids grown": 4,
        "occupancy renewed": 5 + 20,  # at 500, 1500, … of the search, and of the radiance field
    }
    assert SCHEDULES["forward"].planned_events == {
        "grids grown": 4,
        "occupancy renewed": 20,
        "view dependence begun": 1,
        "total variation of touched voxels alone": 1,
    }
    events = Visits(DeformationSchedule(), 50).planned_events
    assert events == {"levels begun": 5, "grids grown": 4, "visits of frames": 5 * 49}


@pytest.mark.parametrize("name", SCHEDULES)
@pytest.mark.parametrize("factor", [1.0, 0.31, 1 / 20, 1 / 42])
def test_a_scaled_schedule_has_the_same_events_in_the_same_order(name, factor):
    schedule = SCHEDULES[name]
    scaled = schedule.scaled(factor)
    assert scaled.total == pytest.approx(factor * schedule.total, abs=1)
    assert scaled.planned_events.keys() == schedule.planned_events.keys()
    for event, count in schedule.planned_events.items():
        assert scaled.planned_events[event] == pytest.approx(count, rel=0.1)
    phases, shorter = (in_order(s.phase, s.total) for s in (schedule, scaled))
    assert [(p.kind, p.voxels) for p in shorter] == [(p.kind, p.voxels) for p in phases]
    for phase, short in zip(phases, shorter, strict=True):
        assert short.stop == pytest.approx(factor * phase.stop, abs=1)
        # Rates have fallen as far.
        fallen = [
            s.learning_rate_factor(p.stop - 1) for s, p in ((schedule, phase), (scaled, short))
        ]
        assert fallen[1] == pytest.approx(fallen[0], abs=0.05)
    assert schedule.scaled(1.0) == schedule


def test_whatever_the_factor_each_phase_keeps_an_iteration():
    scaled = CanonicalSchedule().scaled(1e-6)
    assert [p.stop - p.start for p in in_order(scaled.phase, scaled.total)] == [1] * 6
    levels = DeformationSchedule().scaled(1e-6).levels
    assert [level.iterations for level in levels] == [1] * 5


def test_motion_is_scaled_visit_by_visit_and_reaches_as_far():
    schedule = DeformationSchedule()
    scaled = schedule.scaled(0.1)
    before, after = (deformation_phases(s, frames=9) for s in (schedule, scaled))
    assert [(p.frame, p.level, p.side) for p in after] == [
        (p.frame, p.level, p.side) for p in before
    ]
    assert [level.iterations for level in scaled.levels] == [20, 10, 10, 5, 5]
    visit = VisitSettings()
    # A voxel moves by its rate in each of its iterations, at most; and is looked at as often.
    assert visit.scaled(0.1).learning_rate * 20 == pytest.approx(visit.learning_rate * 200)
    assert (visit.occupancy_every, visit.scaled(0.1).occupancy_every) == (25, 2)


@pytest.mark.parametrize(
    "sides", [[10, 20, 40, 80, 160], [8, 16, 32, 64, 128], [40, 80, 160], [160]]
)
def test_coarser_grids_grow_as_often(sides):
    levels = [Level(side, 10) for side in sides]
    coarser = DeformationSchedule(levels, planes=128).with_finest(40)
    found = [level.side for level in coarser.levels]
    assert found[-1] == 40 and sorted(set(found)) == found and found[0] <= sides[0]
    assert coarser.grid(len(sides) - 1)[1] == round(128 * 40 / sides[-1])
    unchanged = DeformationSchedule([Level(12, 36), Level(12, 18), Level(32, 18)])
    assert unchanged.with_finest(40) == unchanged

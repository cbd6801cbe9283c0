"""Schedules in little time, by hand."""

from __future__ import annotations

import pytest

from devrf.cli.short_schedules import middle_visits, shorter_canonical, shorter_deformation
from devrf.methods.devrf.schedules import CanonicalSchedule, DeformationSchedule


def test_a_fifth_of_the_paper_s_schedules() -> None:
    short = shorter_canonical(CanonicalSchedule(), 0.2)
    assert short.search_iterations == 1000 and short.iterations == 4000
    assert tuple(short.doublings) == (200, 400, 600, 800)
    assert [phase.voxels for phase in short.phases] == [
        phase.voxels for phase in CanonicalSchedule().phases
    ]
    # Learning rates fall by as much.
    assert short.learning_rate_factor(4999) == pytest.approx(
        CanonicalSchedule().learning_rate_factor(24999), rel=1e-3
    )
    moving = shorter_deformation(DeformationSchedule(), 0.2)
    assert tuple(moving.iterations_per_frame) == (40, 20, 20, 10, 10)
    assert moving.sides == DeformationSchedule().sides


def test_nothing_vanishes() -> None:
    tiny = CanonicalSchedule(
        search_iterations=0, iterations=6, doublings=(2, 3), side=16, decay_iterations=10
    )
    short = shorter_canonical(tiny, 0.01)
    assert tuple(short.doublings) == (1, 2) and short.iterations == 3
    assert short.search_iterations == 0 and short.decay_iterations == 1
    moving = DeformationSchedule(sides=(4, 8), iterations_per_frame=(2, 1))
    assert shorter_deformation(moving, 0.01).iterations_per_frame == (1, 1)


def test_the_whole_at_one_resolution_stays_at_one() -> None:
    base = DeformationSchedule(coarse_to_fine=False)
    short = shorter_deformation(base, 0.5)
    assert short.sides == (160,) and tuple(short.iterations_per_frame) == (250,)
    assert not short.coarse_to_fine


@pytest.mark.parametrize(("frames", "frame"), [(50, 25), (3, 1), (2, 1)])
def test_the_middle_frame_of_every_level(frames: int, frame: int) -> None:
    schedule = DeformationSchedule()
    visits = [schedule.phase(iteration, frames) for iteration in middle_visits(schedule, frames)]
    assert [(visit.level, visit.frames) for visit in visits] == [(k, (frame,)) for k in range(5)]


def test_the_middle_visit_of_frames_that_are_visited_together() -> None:
    schedule = DeformationSchedule(
        sides=(4, 6, 8), iterations_per_frame=(3, 2, 4), parallel_frames=(1, 2, 9)
    )
    visits = [schedule.phase(iteration, 7) for iteration in middle_visits(schedule, 7)]
    assert [visit.frames for visit in visits] == [(3,), (2, 6), (1, 3, 5)]
    assert shorter_deformation(schedule, 0.5).parallel_frames == (1, 2, 9)

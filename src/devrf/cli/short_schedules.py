"""Schedules in little time: the same course in fewer iterations, and one visit to each level."""

from __future__ import annotations

from dataclasses import replace

from devrf.methods.devrf.schedules import CanonicalSchedule, DeformationSchedule


def shorter_canonical(schedule: CanonicalSchedule, share: float) -> CanonicalSchedule:
    """The same course in ``share`` of its iterations, learning rates falling as far."""
    doublings, last = [], 0
    for doubling in schedule.doublings:
        last = max(last + 1, round(share * doubling))
        doublings.append(last)
    searching = schedule.search_iterations
    return replace(
        schedule,
        search_iterations=_some(searching, share) if searching else 0,
        iterations=max(last + 1, round(share * schedule.iterations)),
        doublings=tuple(doublings),
        decay_iterations=_some(schedule.decay_iterations, share),
    )


def shorter_deformation(schedule: DeformationSchedule, share: float) -> DeformationSchedule:
    """The same course in ``share`` of its iterations, or in one for each level and frame."""
    shares = tuple(_some(count, share) for count in schedule.iterations_per_frame)
    return replace(schedule, iterations_per_frame=shares)


def middle_visits(schedule: DeformationSchedule, frames: int) -> list[int]:
    """An iteration of the middle visit of each level, going through T = ``frames`` frames."""
    starts = [0, *schedule.growths(frames)]
    return [
        start + schedule.visits(level, frames) // 2 * schedule.iterations_per_frame[level]
        for level, start in enumerate(starts)
    ]


def _some(count: int, share: float) -> int:
    return max(1, round(share * count))

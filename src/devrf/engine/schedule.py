"""Schedules of all stages: pure maps from an iteration to a phase."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from devrf.engine.position import Position
from devrf.errors import DevrfError


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A range of iterations in which the same tensors are learned.

    Between two phases grids grow, or another frame becomes active.

    Attributes:
        kind: the thing that is learned, in a word or two: ``search``, ``fine``, ``level 2``.
        start: first iteration.
        stop: one past the last iteration.
        frame: the frame that is learned; None where all times are learned at once.
    """

    kind: str
    start: int
    stop: int
    frame: int | None = None

    @property
    def cost(self) -> float:
        """Estimated duration of an iteration, in a unit that the stage's phases share."""
        return 1.0


class Schedule(Protocol):
    """A stage's schedule for its scene."""

    @property
    def total(self) -> int:
        """Number of iterations."""
        ...

    @property
    def planned_events(self) -> Mapping[str, int]:
        """Number of times that each event takes place, by the names of :attr:`Stage.events`."""
        ...

    def phase(self, iteration: int) -> Phase:
        """The phase of an iteration; the last one from the end on."""
        ...

    def learning_rate_factor(self, iteration: int) -> float:
        """Factor of the base learning rates at an iteration."""
        ...

    def scaled(self, factor: float) -> Schedule:
        """As many phases in ``factor`` times their iterations."""
        ...


class Scheduled(Protocol):
    """A stage as callbacks of the schedule see it (docs/extending.md#schedule-callbacks).

    Attributes:
        schedule: the present one for the stage's scene, a :class:`Schedule`.
        configured_schedule: the one before it was scaled; None until then.
        phase: the phase whose tensors are ready; None before the first.
        position: the next iteration, and the factor of all learning rates.
        has_scheduled_rates: whether a callback sets the learning rates.
    """

    schedule: Any
    configured_schedule: Any
    phase: Any
    position: Position
    has_scheduled_rates: bool

    def enter(self, phase: Any) -> None:
        """Make grids and optimiser ready for a phase."""
        ...


def phases(schedule: Schedule) -> list[Phase]:
    """All phases, in their order."""
    found: list[Phase] = []
    while not found or found[-1].stop < schedule.total:
        found.append(schedule.phase(found[-1].stop if found else 0))
    return found


def cost(schedule: Schedule, first: int, last: int) -> float:
    """Estimated duration of iterations ``first`` to ``last``, in the unit of the phases' costs."""
    total = 0.0
    while first < last:
        phase = schedule.phase(first)
        stop = min(phase.stop, last)
        total += (stop - first) * phase.cost
        first = stop
    return total


def share_done(schedule: Schedule, iteration: int) -> float:
    """Estimated share of the whole duration that is over before an iteration, 0 to 1."""
    return cost(schedule, 0, iteration) / cost(schedule, 0, schedule.total)


def unscaled(stage: Scheduled) -> Schedule:
    """A stage's schedule as it was configured."""
    schedule: Schedule = stage.configured_schedule or stage.schedule
    return schedule


def entered_phase(stage: Scheduled) -> Phase:
    """The present phase of a stage, for whose iterations grids and learning rates are ready.

    Raises:
        DevrfError: the callback that makes them so is missing.
    """
    iteration = stage.position.iteration
    phase: Phase | None = stage.phase
    if phase is None or phase != stage.schedule.phase(iteration):
        raise DevrfError(
            f"{type(stage).__name__}: the phase of iteration {iteration} was not "
            "entered: add devrf.callbacks.GridUpscaling to the trainer's callbacks"
        )
    if not stage.has_scheduled_rates:
        raise DevrfError(
            f"{type(stage).__name__}: the learning rates of its schedule are not set: add "
            "devrf.callbacks.LearningRateDecay to the trainer's callbacks"
        )
    return phase


def scale_schedule(stage: Scheduled, factor: float) -> None:
    """Have a stage go on at the same place of its schedule in ``factor`` times its iterations."""
    before = stage.schedule
    stage.configured_schedule = unscaled(stage)
    position = stage.position
    entered = stage.phase == before.phase(position.iteration)
    stage.schedule = stage.configured_schedule.scaled(factor)
    position.schedule_scale = factor
    position.iteration = same_place(position.iteration, before, stage.schedule)
    if entered:
        stage.phase = stage.schedule.phase(position.iteration)


def same_place(iteration: int, before: Schedule, after: Schedule) -> int:
    """The iteration of a rescaled schedule at the same share of the same phase."""
    old = phases(before)
    number = next((k for k, phase in enumerate(old) if iteration < phase.stop), len(old))
    if number == len(old):
        return after.total
    phase = phases(after)[number]
    share = (iteration - old[number].start) / (old[number].stop - old[number].start)
    return phase.start + int(share * (phase.stop - phase.start))

"""The deformation stage's schedule: a pure map from an iteration to the frames learned then."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import Any, Literal

from devrf.errors import DevrfError

# In time, from a visit of a level to the next.
Order = Literal["forward", "backward"]


@dataclass(frozen=True)
class Level:
    """One resolution of the motion grids, and how the frames are learned at it.

    Attributes:
        side: the motion grids have about side³ voxels. A level may have the side of the one before
            it: the same grids are then gone through once more.
        iterations: share of each frame.
        lr_factor: of the learning rate; None: the schedule's ``decay`` to the power of how often
            the side has changed.
        lr_final_factor: what the learning rate falls to in the course of a visit, exponentially,
            as a factor.
        order: of the frames, in time; ``forward`` at the coarsest level.
        parallel_frames: K, how many frames may be learned in parallel; 1 at the coarsest level,
            where a frame starts from the one before it.
        weight_factors: of the weights of ``loss.deformation``, by the term's name; 1 for terms
            that are not named.
    """

    side: int
    iterations: int
    lr_factor: float | None = None
    lr_final_factor: float = 1.0
    order: Order = "forward"
    parallel_frames: int = 1
    weight_factors: Mapping[str, float] = field(default_factory=dict)


PAPER_LEVELS = (Level(10, 200), Level(20, 100), Level(40, 100), Level(80, 50), Level(160, 50))


@dataclass(frozen=True)
class DeformationPhase:
    """A visit to one frame at one resolution, or to several in parallel.

    Attributes:
        level: 0 is the coarsest resolution.
        frames: the frames that are learned, from 1 on, ascending.
        start: first iteration.
        stop: one past the last iteration.
        side: side of the motion grid: it has about side³ voxels.
        learning_rate_factor: what the learning rate is multiplied by at the visit's start.
        lr_final_factor: what it has been multiplied by further at the visit's end.
        init_from_previous: whether the frame starts from the result of the frame before it.
        has_previous: whether the frames before these have been learned at this level, or are at
            rest.
        backward: whether the frames after these are visited before them.
    """

    level: int
    frames: tuple[int, ...]
    start: int
    stop: int
    side: int
    learning_rate_factor: float
    lr_final_factor: float
    init_from_previous: bool
    has_previous: bool
    backward: bool = False

    @property
    def kind(self) -> str:
        """The level, in words, by the number of its row."""
        return f"level {self.level + 1}"


@dataclass(frozen=True)
class DeformationSchedule:
    """The deformation stage's visits; the defaults are the paper's, inward-facing.

    See docs/method.md#coarse-to-fine.

    Within a level the frames t = 1, …, T − 1 are visited one after another, each for the level's
    share of iterations. Frame 0 is the identity; frame 1 gets its share, so that a level takes
    share · T iterations.

    Where K frames may be learned in parallel, the T frames are cut into contiguous stretches of
    L = max(2, ⌈T / K⌉) frames, so that neighbours are never learned together. Visit j of the level,
    0 ≤ j < L, is to the j-th frame of every stretch: frames j, j + L, j + 2L, … without frame 0.
    An iteration is one optimiser step on all of them, each with a batch of its own, so a level
    takes share · L iterations. The first frame of a stretch is learned before the frame before it;
    that one is known from the level before. With a single stretch visit 0 would be empty, and
    frame 1 gets its share as above.

    A level whose order is ``backward`` makes the same visits from the last to the first; where
    frame 0 is alone, its share goes to the last frame.

    Attributes:
        levels: coarse to fine.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate, each
            frame starting from rest (``ablation=base``, docs/method.md#ablations).
        decay: factor of the learning rate from a level to the next, if its side is another one.
        rays: of a batch.
    """

    levels: Sequence[Level] = PAPER_LEVELS
    coarse_to_fine: bool = True
    decay: float = 10 ** (-1 / 4)
    rays: int = 8192

    @classmethod
    def from_rows(
        cls,
        levels: Mapping[str, Level | None],
        coarse_to_fine: bool = True,
        decay: float = 10 ** (-1 / 4),
        rays: int = 8192,
    ) -> DeformationSchedule:
        """The schedule of a config, whose levels are rows that are named ``1``, ``2`` and so on.

        Args:
            levels: the values of a :class:`Level` in each row; null leaves a row out, so that a
                schedule may have fewer levels than the one that it starts from.
            coarse_to_fine: as of the schedule.
            decay: likewise.
            rays: likewise.

        Raises:
            DevrfError: a row between two others is missing, or lacks its side or iterations.
        """
        rows: dict[str, Any] = {str(name): row for name, row in levels.items() if row is not None}
        numbered = []
        for number in range(1, len(rows) + 1):
            row = rows.get(str(number))
            if row is None or not {"side", "iterations"} <= set(row):
                raise DevrfError(
                    f"schedule.deformation.levels: expected rows 1 to {len(rows)} with side and "
                    f"iterations, which row {number} has not; there are {', '.join(sorted(rows))}"
                )
            numbered.append(Level(**row))
        return cls(numbered, coarse_to_fine, decay, rays)

    def __post_init__(self) -> None:
        if not self.levels:
            raise DevrfError("schedule.deformation.levels: expected at least one")
        if self.rays < 1:
            raise DevrfError(f"schedule.deformation.rays: expected at least 1, not {self.rays}")
        if not self.decay > 0:
            raise DevrfError(f"schedule.deformation.decay: expected more than 0, not {self.decay}")
        for number, level in enumerate(self.levels, 1):
            _check_level(f"schedule.deformation.levels.{number}", level)
        first, last = self.levels[0], self.levels[-1]
        if self.coarse_to_fine and first.parallel_frames > 1:
            raise DevrfError(
                "schedule.deformation.levels.1.parallel_frames: expected 1 at the first level, "
                f"where a frame starts from the one before it, not {first.parallel_frames}"
            )
        if first.order != "forward":
            raise DevrfError(
                "schedule.deformation.levels.1.order: expected forward at the first level, where a "
                f"frame starts from the one before it, not {first.order}"
            )
        if not self.coarse_to_fine:
            iterations = sum(level.iterations for level in self.levels)
            finest = replace(last, iterations=iterations, lr_factor=None, order="forward")
            object.__setattr__(self, "levels", (finest,))

    def check_terms(self, known: Collection[str]) -> None:
        """Check that the levels' ``weight_factors`` are of ``known`` loss terms.

        Raises:
            DevrfError: there is no such term.
        """
        for number, level in enumerate(self.levels, 1):
            for name in level.weight_factors:
                if name not in known:
                    raise DevrfError(
                        f"schedule.deformation.levels.{number}.weight_factors: {name} is no term "
                        f"of loss.deformation; the terms are {', '.join(sorted(known))}"
                    )

    def learning_rate_factor(self, level: int) -> float:
        """Factor of the learning rate when a visit of ``level`` begins."""
        factor = self.levels[level].lr_factor
        if factor is not None:
            return factor
        sides = [row.side for row in self.levels[: level + 1]]
        return self.decay ** sum(a != b for a, b in pairwise(sides))

    def weight_factor(self, term: str, level: int) -> float:
        """Factor of the weight of a loss term at ``level``."""
        return self.levels[level].weight_factors.get(term, 1.0)

    def visits(self, level: int, frames: int) -> int:
        """L of T = ``frames`` frames: visits of a level, and the distance of parallel frames."""
        return max(2, -(-frames // self.levels[level].parallel_frames))

    def max_parallel_frames(self, level: int, frames: int) -> int:
        """The most of T = ``frames`` frames that a level learns in parallel."""
        return len(range(1, frames, self.visits(level, frames)))

    def total(self, frames: int) -> int:
        """Iterations of the whole stage for T = ``frames`` frames, frame 0 included."""
        return sum(self._lengths(frames))

    def growths(self, frames: int) -> list[int]:
        """Iterations at which a further level begins; the motion grid grows if its side does."""
        return list(accumulate(self._lengths(frames)[:-1]))

    def _lengths(self, frames: int) -> list[int]:
        """Iterations of each level."""
        return [row.iterations * self.visits(k, frames) for k, row in enumerate(self.levels)]

    def phase(self, iteration: int, frames: int) -> DeformationPhase:
        """The visit that ``iteration`` belongs to; the last one from the end on."""
        begins = [0, *self.growths(frames)]
        level = bisect_right(begins, iteration) - 1
        begin, apart, row = begins[level], self.visits(level, frames), self.levels[level]
        first = 1 if apart == frames else 0  # frame 0 alone
        visit = min(max((iteration - begin) // row.iterations, first), apart - 1)
        backward = row.order == "backward"
        place = first + apart - 1 - visit if backward else visit
        visited = tuple(range(place or apart, frames, apart))
        return DeformationPhase(
            level=level,
            frames=visited,
            start=begin + (0 if visit == first else visit * row.iterations),
            stop=begin + (visit + 1) * row.iterations,
            side=row.side,
            learning_rate_factor=self.learning_rate_factor(level),
            lr_final_factor=row.lr_final_factor,
            init_from_previous=self.coarse_to_fine and level == 0 and visit > 1,
            has_previous=visit > 0 and not backward,
            backward=backward,
        )


def _check_level(key: str, level: Level) -> None:
    """Check what holds for every level; ``key`` is that of its row."""
    for name, bound in (("side", 2), ("iterations", 1), ("parallel_frames", 1)):
        if getattr(level, name) < bound:
            raise DevrfError(f"{key}.{name}: expected at least {bound}, not {getattr(level, name)}")
    for name in ("lr_factor", "lr_final_factor"):
        factor = getattr(level, name)
        if factor is not None and not factor > 0:
            raise DevrfError(f"{key}.{name}: expected more than 0, not {factor}")
    if level.order not in ("forward", "backward"):
        raise DevrfError(f"{key}.order: expected forward or backward, not {level.order}")
    for term, factor in level.weight_factors.items():
        if factor < 0:
            raise DevrfError(f"{key}.weight_factors.{term}: expected at least 0, not {factor}")

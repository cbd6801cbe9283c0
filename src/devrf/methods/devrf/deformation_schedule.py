"""The deformation stage's schedule: a pure map from an iteration to the frames learned then."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import accumulate, pairwise
from typing import Any

from devrf.engine.learner import Phase
from devrf.errors import DevrfError, expect

# Motion grids of this side take Adam about as long as a batch of rays takes; estimated.
FINE_SIDE = 160


@dataclass(frozen=True)
class Level:
    """One resolution of the motion grids, and how the frames are learned at it.

    Attributes:
        side: the motion grids have about side³ voxels, maybe as many as at the level before.
        iterations: share of each frame.
        lr_factor: of the learning rate; None: the schedule's ``decay`` to the power of how often
            the side has changed.
        lr_final_factor: what the learning rate falls to in a visit, exponentially.
        other_terms: factor of the weights of all terms of ``loss.deformation`` but ``render``.
        parallel_frames: K, how many frames may be learned in parallel; 1 at the coarsest level,
            where a frame starts from the one before it.
    """

    side: int
    iterations: int
    lr_factor: float | None = None
    lr_final_factor: float = 1.0
    other_terms: float = 1.0
    parallel_frames: int = 1


PAPER_LEVELS = (Level(10, 200), Level(20, 100), Level(40, 100), Level(80, 50), Level(160, 50))


@dataclass(frozen=True, kw_only=True)
class DeformationPhase(Phase):
    """A visit to one frame at one resolution, or to several in parallel.

    Attributes:
        level: 0 is the coarsest resolution.
        side: the motion grid has about side³ voxels.
        learning_rate_factor: what the learning rate is multiplied by at the visit's start.
        lr_final_factor: what it has been multiplied by further at the visit's end.
        init_from_previous: whether the frame starts from the result of the frame before it.
        has_previous: whether the frames before these have been learned at this level, or are at
            rest.
    """

    level: int
    side: int
    learning_rate_factor: float
    lr_final_factor: float
    init_from_previous: bool
    has_previous: bool

    @property
    def cost(self) -> float:
        """A batch of rays for each frame, beside which Adam on motion grids counts only if fine."""
        return len(self.frames) * (1 + (self.side / FINE_SIDE) ** 3)

    def learning_rate_at(self, iteration: int) -> float:
        """Factor of the learning rate in the visit (docs/method.md#motion-learning-rate)."""
        share = (iteration - self.start) / (self.stop - self.start)
        return self.learning_rate_factor * math.pow(self.lr_final_factor, share)


@dataclass(frozen=True)
class DeformationSchedule:
    """The deformation stage's visits; the defaults are the paper's, inward-facing.

    See docs/method.md#coarse-to-fine. Frame 0 is the identity; its share of a level's iterations
    goes to the frame that is visited first.

    Where K frames may be learned in parallel, the T frames are cut into contiguous stretches of
    L = max(2, ⌈T / K⌉) frames, so that neighbours are never learned together. Visit j, 0 ≤ j < L,
    is to the j-th frame of every stretch: j, j + L, j + 2L, … without frame 0. An iteration is one
    optimiser step on all of them, each with a batch of its own: a level takes share · L of them.

    Attributes:
        levels: coarse to fine.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate, each
            frame starting from the one before it (``ablation=base``, docs/method.md#ablations).
        decay: factor of the learning rate from a level to the next, if its side is another one.
        rays: of a batch.
        planes: grid points along z at the finest level, in proportion to ``side`` at the others;
            None: voxels are cubes.
    """

    levels: Sequence[Level] = PAPER_LEVELS
    coarse_to_fine: bool = True
    decay: float = 10 ** (-1 / 4)
    rays: int = 8192
    planes: int | None = None

    @classmethod
    def from_rows(cls, levels: Mapping[str, Level | None], **settings: Any) -> DeformationSchedule:
        """The schedule of a config, whose ``levels`` are rows named ``1``, ``2`` and so on.

        null leaves a row out: a schedule may have fewer levels than the one that it starts from.

        Raises:
            DevrfError: a row between two others is missing, or lacks its side or iterations.
        """
        rows: dict[str, Any] = {str(name): row for name, row in levels.items() if row is not None}
        numbered = []
        for number in range(1, len(rows) + 1):
            row = rows.get(str(number), {})
            if not {"side", "iterations"} <= set(row):
                raise DevrfError(
                    f"schedule.deformation.levels: expected rows 1 to {len(rows)} with side and "
                    f"iterations, which row {number} has not; there are {', '.join(sorted(rows))}"
                )
            numbered.append(Level(**row))
        return cls(numbered, **settings)

    def __post_init__(self) -> None:
        key = "schedule.deformation"
        expect(len(self.levels) > 0, f"{key}.levels", "at least one", "none")
        expect(self.rays >= 1, f"{key}.rays", "at least 1", self.rays)
        expect(self.decay > 0, f"{key}.decay", "more than 0", self.decay)
        dense = self.planes is None or self.planes >= 2
        expect(dense, f"{key}.planes", "at least 2, or null", self.planes)
        for number, level in enumerate(self.levels, 1):
            _check_level(f"{key}.levels.{number}", level)
        first, last = self.levels[0], self.levels[-1]
        together = first.parallel_frames if self.coarse_to_fine else 1
        expected = "1 at the first level, where a frame starts from the one before it"
        expect(together == 1, f"{key}.levels.1.parallel_frames", expected, together)
        if not self.coarse_to_fine:
            iterations = sum(level.iterations for level in self.levels)
            parallel = first.parallel_frames
            finest = replace(last, iterations=iterations, parallel_frames=parallel, lr_factor=None)
            object.__setattr__(self, "levels", (finest,))

    def grid(self, level: int) -> tuple[int, int | None]:
        """About how many voxels the motion grids of a level have, and their planes, if given."""
        side, finest = self.levels[level].side, self.levels[-1].side
        return side**3, self.planes and round(self.planes * side / finest)

    def learning_rate_factor(self, level: int) -> float:
        """Factor of the learning rate when a visit of ``level`` begins."""
        factor = self.levels[level].lr_factor
        if factor is not None:
            return factor
        sides = [row.side for row in self.levels[: level + 1]]
        return self.decay ** sum(a != b for a, b in pairwise(sides))

    def _stretch(self, level: int, frames: int) -> int:
        """L of T = ``frames`` frames."""
        return max(2, -(-frames // self.levels[level].parallel_frames))

    def max_parallel_frames(self, level: int, frames: int) -> int:
        """The most of T = ``frames`` frames that a level learns in parallel."""
        return len(range(1, frames, self._stretch(level, frames)))

    def total(self, frames: int) -> int:
        """Iterations of the whole stage for T = ``frames`` frames, frame 0 included."""
        return sum(self._lengths(frames))

    def growths(self, frames: int) -> list[int]:
        """Iterations at which a further level begins; the motion grid grows if its side does."""
        return list(accumulate(self._lengths(frames)[:-1]))

    def _lengths(self, frames: int) -> list[int]:
        """Iterations of each level."""
        return [row.iterations * self._stretch(k, frames) for k, row in enumerate(self.levels)]

    def phase(self, iteration: int, frames: int) -> DeformationPhase:
        """The visit that ``iteration`` belongs to; the last one from the end on."""
        begins = [0, *self.growths(frames)]
        level = bisect_right(begins, iteration) - 1
        begin, row, stretch = begins[level], self.levels[level], self._stretch(level, frames)
        visits = _visits(frames, stretch)
        unvisited = stretch - len(visits)  # the first visit takes the share of frame 0 alone, too
        visit = min(max((iteration - begin) // row.iterations - unvisited, 0), len(visits) - 1)
        visited = tuple(visits[visit])
        return DeformationPhase(
            kind=f"level {level + 1}",
            start=begin + (unvisited + visit if visit else 0) * row.iterations,
            stop=begin + (unvisited + visit + 1) * row.iterations,
            frames=visited,
            level=level,
            side=row.side,
            learning_rate_factor=self.learning_rate_factor(level),
            lr_final_factor=row.lr_final_factor,
            init_from_previous=level == 0 and visit > 0,
            has_previous=visit > 0 or visited == (1,),
        )


@cache
def _visits(frames: int, stretch: int) -> list[range]:
    """The frames of each visit: of 6 in stretches of 3, frame 3, then 1 and 4, then 2 and 5."""
    # Visit 0 leaves out frame 0.
    visits = [range(place or stretch, frames, stretch) for place in range(stretch)]
    return visits if visits[0] else visits[1:]


def _check_level(key: str, level: Level) -> None:
    """Check what holds for every level; ``key`` is that of its row."""
    for name, least in (("side", 2), ("iterations", 1), ("parallel_frames", 1)):
        value = getattr(level, name)
        expect(value >= least, f"{key}.{name}", f"at least {least}", value)
    expect(level.other_terms >= 0, f"{key}.other_terms", "at least 0", level.other_terms)
    for name in ("lr_factor", "lr_final_factor"):
        factor = getattr(level, name)
        expect(factor is None or factor > 0, f"{key}.{name}", "more than 0", factor)

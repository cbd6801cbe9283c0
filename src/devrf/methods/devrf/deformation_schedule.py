"""The deformation stage's schedule: a pure map from an iteration to the frames learned then."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, pairwise
from typing import Annotated, Any, ClassVar

import pydantic.dataclasses
from annotated_types import MinLen

from devrf.engine.schedule import Phase
from devrf.errors import DevrfError
from devrf.system.options import Count, NotNegative, Options, Positive, Several

# Displacement grids of this side take Adam about as long as a batch of rays takes; estimated.
FINE_SIDE = 160

# Events of the stage.
LEVELS = "levels begun"
GROWN = "grids grown"
VISITS = "visits of frames"


@pydantic.dataclasses.dataclass(frozen=True)
class Level(Options):
    """One resolution of the displacement grids, and the settings of the frames' visits at it.

    Attributes:
        side: the displacement grids have about side³ voxels, maybe as many as at the level before.
        iterations: share of each frame.
        lr_factor: of the learning rate; None: the schedule's ``decay`` to the power of how often
            the side has changed.
        lr_final_factor: of the learning rate at a visit's end; it falls exponentially.
        other_terms: factor of the weights of all terms of ``loss.deformation`` but ``render``.
        backwards: whether frames are gone through from the last to the first; not at the coarsest
            level, which begins at rest.
    """

    key: ClassVar[str] = "schedule.deformation.levels"

    side: Several
    iterations: Count
    lr_factor: Positive | None = None
    lr_final_factor: Positive = 1.0
    other_terms: NotNegative = 1.0
    backwards: bool = False


PAPER_LEVELS = (Level(10, 200), Level(20, 100), Level(40, 100), Level(80, 50), Level(160, 50))


@dataclass(frozen=True, kw_only=True)
class DeformationPhase(Phase):
    """A visit to one frame at one resolution.

    Attributes:
        frame: the frame, from 1 on.
        level: 0 is the coarsest resolution.
        side: the displacement grid has about side³ voxels.
        rate_factor: of the learning rate at the visit's start.
        lr_final_factor: a further factor of it at the visit's end.
        init_from_previous: whether the frame starts from the result of the frame before it.
        step: 1, or −1 where frames are gone through from the last to the first.
    """

    frame: int
    level: int
    side: int
    rate_factor: float
    lr_final_factor: float
    init_from_previous: bool
    step: int = 1

    @property
    def cost(self) -> float:
        """A batch of rays, beside which Adam on displacement grids counts only if they are fine."""
        return 1 + (self.side / FINE_SIDE) ** 3

    def learning_rate_at(self, iteration: int) -> float:
        """Factor of the learning rate in the visit (docs/method.md#deformation-learning-rate)."""
        return self.rate_factor * math.pow(self.lr_final_factor, self.share(iteration))

    def share(self, iteration: int) -> float:
        """The share of the visit that is over, from 0 to below 1."""
        return (iteration - self.start) / (self.stop - self.start)


@pydantic.dataclasses.dataclass(frozen=True)
class DeformationSchedule(Options):
    """The deformation stage's visits; the defaults are the paper's, inward-facing.

    See docs/method.md#coarse-to-fine. Frame 0 is the identity; its share of a level's iterations
    goes to the frame that is visited first.

    Attributes:
        levels: coarse to fine.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate and with
            whole weights, each frame starting from the one before it (``ablation=base``,
            docs/method.md#ablations).
        decay: factor of the learning rate from a level to the next, if its side is another one.
        rays: of a batch.
        planes: grid points along z at the finest level, in proportion to ``side`` at the others;
            None: voxels are cubes.
    """

    key: ClassVar[str] = "schedule.deformation"

    levels: Annotated[Sequence[Level], MinLen(1)] = PAPER_LEVELS
    coarse_to_fine: bool = True
    decay: Positive = 10 ** (-1 / 4)
    rays: Count = 8192
    planes: Several | None = None

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
            row = rows.get(str(number))
            if isinstance(row, Level):
                row = asdict(row)
            if not isinstance(row, Mapping) or not {"side", "iterations"} <= set(row):
                raise DevrfError(
                    f"schedule.deformation.levels: expected rows 1 to {len(rows)} with side and "
                    f"iterations, which row {number} has not; there are {', '.join(sorted(rows))}"
                )
            numbered.append(Level(**row))
        return cls(numbered, **settings)

    def __post_init__(self) -> None:
        if not self.coarse_to_fine:
            iterations = sum(level.iterations for level in self.levels)
            finest = Level(side=self.levels[-1].side, iterations=iterations)
            object.__setattr__(self, "levels", (finest,))
        if self.levels[0].backwards:
            raise DevrfError(
                "schedule.deformation.levels.1.backwards: expected false, not true: the first "
                "level goes on from the scene at rest, which is frame 0"
            )

    def scaled(self, factor: float) -> DeformationSchedule:
        """The schedule in ``factor`` times its iterations; each visit keeps one at least."""
        rows = [replace(r, iterations=max(1, round(r.iterations * factor))) for r in self.levels]
        return replace(self, levels=rows)

    def with_finest(self, side: int) -> DeformationSchedule:
        """The schedule with grids of at most about ``side``³ voxels, as many of them different.

        Steps from level to level shrink alike, on a logarithmic scale.
        """
        sides = [row.side for row in self.levels]
        coarsest = min(sides)
        finest = max(sides)
        if finest <= side:
            return self
        first = min(coarsest, side // 2)
        steps = math.log(finest / coarsest)
        power = math.log(side / first) / steps if steps else 0.0
        rows = [
            replace(row, side=round(side * (row.side / finest) ** power)) for row in self.levels
        ]
        planes = self.planes and max(2, round(self.planes * side / finest))
        return replace(self, levels=rows, planes=planes)

    def grid(self, level: int) -> tuple[int, int | None]:
        """About how many voxels a level's displacement grids have, and their planes, if given."""
        side = self.levels[level].side
        finest = self.levels[-1].side
        return side**3, self.planes and round(self.planes * side / finest)

    def level_rate_factor(self, level: int) -> float:
        """Factor of the learning rate when a visit of ``level`` begins."""
        factor = self.levels[level].lr_factor
        if factor is not None:
            return factor
        sides = [row.side for row in self.levels[: level + 1]]
        return self.decay ** sum(a != b for a, b in pairwise(sides))


@dataclass(frozen=True)
class Visits:
    """The schedule of a scene of T frames (:class:`~devrf.engine.schedule.Schedule`).

    Attributes:
        settings: levels and iterations.
        frames: T, frame 0 included.
    """

    settings: DeformationSchedule
    frames: int

    @property
    def total(self) -> int:
        """Iterations of the whole stage."""
        return sum(self._lengths)

    @property
    def level_starts(self) -> list[int]:
        """Iterations at which a further level begins; displacement grids grow if its side does."""
        return list(accumulate(self._lengths[:-1]))

    @property
    def _lengths(self) -> list[int]:
        """Iterations of each level."""
        return [row.iterations * self.frames for row in self.settings.levels]

    @property
    def planned_events(self) -> Mapping[str, int]:
        """Numbers of levels, growths of the grid, and visits."""
        levels = self.settings.levels
        grown = sum(a.side != b.side for a, b in pairwise(levels))
        counts = {LEVELS: len(levels), GROWN: grown, VISITS: len(levels) * (self.frames - 1)}
        return {name: count for name, count in counts.items() if count}

    def phase(self, iteration: int) -> DeformationPhase:
        """The visit that ``iteration`` belongs to; the last one from the end on."""
        begins = [0, *self.level_starts]
        level = bisect_right(begins, iteration) - 1
        row = self.settings.levels[level]
        # The frame that is visited first takes the share of frame 0, too.
        share = (iteration - begins[level]) // row.iterations
        number = min(max(share, 1), self.frames - 1)
        return DeformationPhase(
            kind=f"level {level + 1}",
            start=begins[level] + (number if number > 1 else 0) * row.iterations,
            stop=begins[level] + (number + 1) * row.iterations,
            frame=self.frames - number if row.backwards else number,
            level=level,
            side=row.side,
            rate_factor=self.settings.level_rate_factor(level),
            lr_final_factor=row.lr_final_factor,
            init_from_previous=level == 0 and number > 1,
            step=-1 if row.backwards else 1,
        )

    def learning_rate_factor(self, iteration: int) -> float:
        """Factor of the iteration's level, and within its visit."""
        return self.phase(iteration).learning_rate_at(iteration)

    def scaled(self, factor: float) -> Visits:
        """The same visits in ``factor`` times their iterations."""
        return replace(self, settings=self.settings.scaled(factor))

"""The canonical stage's schedule: a pure map from an iteration to its phase."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, ClassVar

import pydantic.dataclasses
from annotated_types import Ge, Gt, Le

from devrf.engine.schedule import Phase
from devrf.errors import DevrfError, expect
from devrf.geometry.space import Space
from devrf.system.options import Count, NotNegative, Options, Several, Whole

Side = Annotated[float, Ge(2)]

# Events of the stage.
SEARCHED = "geometry searched"
GROWN = "grids grown"
RENEWED = "occupancy renewed"
DIRECTIONS = "view dependence begun"
SMOOTHED_LESS = "total variation of touched voxels alone"


@dataclass(frozen=True, kw_only=True)
class CanonicalPhase(Phase):
    """A stretch of the canonical stage with one grid of about so many ``voxels``.

    Its kind is ``search`` for the coarse geometry, ``fine`` for the radiance field.
    """

    voxels: int

    @property
    def cost(self) -> float:
        """Grows with the side of the grid, and so with the samples of a ray."""
        return float(self.voxels ** (1 / 3))


@pydantic.dataclasses.dataclass(frozen=True)
class CanonicalSchedule(Options):
    """The canonical stage's phases; the defaults are the paper's, inward-facing.

    See docs/method.md#geometry-search, #radiance-field, #forward-facing and #scene-contraction.

    Attributes:
        search_iterations: of the coarse geometry; 0, and contracted space, leave it out.
        search_side: the search grid has about search_side³ voxels.
        visual_hull_init: begin with the visual hull of the static views, if they have alpha masks.
        iterations: of the radiance field.
        side: the final grid has about side³ voxels.
        upsample_at: iterations, from the search's end, at which the number of voxels doubles.
        decay_iterations: after as many iterations the learning rates have fallen to a tenth.
        restart_at_growth: whether decay and optimiser begin anew when the grid has grown.
        density_drop: subtracted from raw densities when the grid has grown.
        occupancy_every: iterations between renewals of the occupancy; None: only at growth.
        rays: of a batch.
        min_views: cells that fewer training views see are empty from the start.
        dense_tv_iterations: so long the total variation smooths untouched voxels, too.
        voxels_per_pixel: grid points for each pixel across. Forward-facing it decides ``side``;
            else the grid is no finer (docs/method.md#resolution).
        epochs: batches are smaller if all iterations would show each pixel more often.
        view_dependence_start: iteration from which colours depend on the viewing direction. None:
            0; in contracted space half of ``iterations``.
        unbounded_initial_side: of the grid in contracted space. None: as ``upsample_at`` says.
        unbounded_distortion: weight of the distortion loss there, from that iteration on.
        first_frames: learn from the dynamic views' first frames, too: they show it at rest.
        crop: forward-facing, whether the grid gives up empty depths (docs/method.md#crop).
    """

    key: ClassVar[str] = "schedule.canonical"

    search_iterations: Whole = 5000
    search_side: Several = 100
    visual_hull_init: bool = False
    iterations: Count = 20000
    side: Side = 160
    upsample_at: Sequence[int] = (1000, 2000, 3000, 4000)
    decay_iterations: Count = 20000
    restart_at_growth: bool = True
    density_drop: NotNegative = 1.0
    occupancy_every: Several | None = 1000
    rays: Count = 8192
    min_views: Count = 3
    dense_tv_iterations: Whole = 0
    voxels_per_pixel: Annotated[float, Gt(0), Le(4)] | None = None
    epochs: Annotated[float, Ge(1)] | None = None
    view_dependence_start: Whole | None = None
    unbounded_initial_side: Side | None = 26
    unbounded_distortion: NotNegative = 0.01
    first_frames: bool = False
    crop: bool = False
    phases: tuple[CanonicalPhase, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        doublings = len(self.upsample_at)
        edges = [0, *self.upsample_at, self.iterations]
        if self.side**3 < 8 * 2**doublings:
            raise DevrfError(
                f"{self.key}.upsample_at: {doublings} of them are too many for side {self.side}; "
                "start from 8 voxels or more"
            )
        ascend = all(a < b for a, b in pairwise(edges))
        between = f"ascending numbers between 0 and iterations ({self.iterations})"
        expect(ascend, f"{self.key}.upsample_at", between, list(self.upsample_at))
        offset = self.search_iterations
        phases = []
        if offset:
            voxels = self.search_side**3
            phases.append(CanonicalPhase(kind="search", start=0, stop=offset, voxels=voxels))
        for k, (start, stop) in enumerate(pairwise(edges)):
            first = offset + start
            last = offset + stop
            voxels = round(self.side**3) // 2 ** (doublings - k)
            phases.append(CanonicalPhase(kind="fine", start=first, stop=last, voxels=voxels))
        object.__setattr__(self, "phases", tuple(phases))

    @property
    def total(self) -> int:
        """Iterations of the whole stage."""
        return self.search_iterations + self.iterations

    def scaled(self, factor: float) -> CanonicalSchedule:
        """The schedule in ``factor`` times its iterations: every event happens, in its order.

        Each phase keeps one iteration at least.
        """

        def whole(iterations: float, least: int = 0) -> int:
            return max(least, round(iterations * factor))

        upsample_at: list[int] = []
        for iteration in self.upsample_at:
            upsample_at.append(whole(iteration, least=upsample_at[-1] + 1 if upsample_at else 1))
        searches = self.search_iterations > 0
        smooths = self.dense_tv_iterations > 0
        late = self.view_dependence_start
        every = self.occupancy_every
        return replace(
            self,
            search_iterations=whole(self.search_iterations, least=1 if searches else 0),
            iterations=whole(self.iterations, least=upsample_at[-1] + 1 if upsample_at else 1),
            upsample_at=tuple(upsample_at),
            decay_iterations=whole(self.decay_iterations, least=1),
            occupancy_every=None if every is None else whole(every, least=2),
            dense_tv_iterations=whole(self.dense_tv_iterations, least=1 if smooths else 0),
            view_dependence_start=None if late is None else whole(late, least=1 if late else 0),
        )

    @property
    def planned_events(self) -> dict[str, int]:
        """Counts of the schedule's events, by name, as in :attr:`Stage.events`."""
        lengths = (self.search_iterations, self.iterations)
        every = self.occupancy_every
        renewals = 0 if every is None else sum((n - 1 + every // 2) // every for n in lengths if n)
        late = 0 < (self.view_dependence_start or 0) < self.iterations
        smooths_less = 0 < self.dense_tv_iterations < self.iterations
        counts = {
            SEARCHED: int(self.search_iterations > 0),
            GROWN: len(self.upsample_at),
            RENEWED: renewals,
            DIRECTIONS: int(late),
            SMOOTHED_LESS: int(smooths_less),
        }
        return {name: count for name, count in counts.items() if count}

    def phase(self, iteration: int) -> CanonicalPhase:
        """The phase that ``iteration`` belongs to; the last one from the end on."""
        return next((p for p in self.phases if iteration < p.stop), self.phases[-1])

    def smooths_all(self, iteration: int) -> bool:
        """Whether the total variation of ``iteration`` reaches untouched voxels too."""
        return 0 <= iteration - self.search_iterations < self.dense_tv_iterations

    def learns_directions(self, iteration: int) -> bool:
        """Whether the network learns from viewing directions at ``iteration``."""
        return iteration - self.search_iterations >= (self.view_dependence_start or 0)

    def in_space(self, space: Space) -> CanonicalSchedule:
        """The schedule, changed for contracted space (docs/method.md#scene-contraction)."""
        if space.is_linear:
            return self
        side = self.side * space.side_factor
        upsample_at = self.upsample_at
        if self.unbounded_initial_side is not None:
            count = max(0, round(3 * math.log2(side / self.unbounded_initial_side)))
            upsample_at = [3 * self.iterations * k // (4 * count) for k in range(1, count + 1)]
        late = self.view_dependence_start
        return replace(
            self,
            search_iterations=0,
            side=side,
            search_side=round(self.search_side * space.side_factor),
            upsample_at=tuple(upsample_at),
            view_dependence_start=self.iterations // 2 if late is None else late,
        )

    def learning_rate_factor(self, iteration: int) -> float:
        """0.1^(n / decay_iterations), n from the start of the phase, or of the radiance field."""
        first = 0 if iteration < self.search_iterations else self.search_iterations
        if self.restart_at_growth:
            first = self.phase(iteration).start
        return float(0.1 ** ((iteration - first) / self.decay_iterations))

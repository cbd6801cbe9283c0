"""The canonical stage's schedule: a pure map from an iteration to what is learned then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from devrf.errors import DevrfError
from devrf.geometry.space import Space


@dataclass(frozen=True)
class CanonicalPhase:
    """A stretch of the canonical stage with one grid.

    Attributes:
        kind: ``search`` for the coarse geometry, ``fine`` for the radiance field.
        start: first iteration.
        stop: one past the last iteration.
        voxels: about how many voxels the grids have.
        frames: none: the scene is at rest.
    """

    kind: Literal["search", "fine"]
    start: int
    stop: int
    voxels: int
    frames: tuple[int, ...] = ()


@dataclass(frozen=True)
class CanonicalSchedule:
    """The canonical stage's phases; the defaults are the paper's, inward-facing.

    See docs/method.md#geometry-search and docs/method.md#radiance-field.

    Attributes:
        search_iterations: length of the coarse geometry search; 0 leaves it out.
        search_side: the search grid has about search_side³ voxels.
        visual_hull_init: begin with the visual hull of the static views, if the images have alpha
            masks; then the search may be short, or left out.
        iterations: length of the radiance field's learning.
        side: the final grid has about side³ voxels.
        upsample_at: iterations, from the search's end, at which the number of voxels doubles; it
            starts at side³ / 2^len(upsample_at).
        decay_iterations: after as many iterations the learning rates have fallen to a tenth.
        rays: of a batch.
        min_views: cells that fewer training views have in the picture are empty from the
            start; 1 keeps those that no camera sees as well.
        dense_tv_iterations: so long, from the search's end, the total variation smooths all
            voxels; afterwards those that a batch has touched.
        voxels_per_pixel: in forward-facing scenes, grid points for each pixel of a row or column;
            decides ``side``. None: ``side`` is as it says.
        view_dependence_start: so many iterations from the search's end colours do not depend on the
            viewing direction. None: 0; in contracted space half of ``iterations``
            (docs/method.md#scene-contraction).
        unbounded_initial_side: in contracted space the grid starts with about as many voxels
            along an edge, and doubles at equal intervals over the first three quarters of
            ``iterations`` in place of ``upsample_at``. None: ``upsample_at`` holds there, too.
        crop: in forward-facing scenes, whether the grid, each time it grows, gives up the depths
            at which the static views see nothing (docs/method.md#crop).
    """

    search_iterations: int = 5000
    search_side: int = 100
    visual_hull_init: bool = False
    iterations: int = 20000
    side: float = 160
    upsample_at: Sequence[int] = (1000, 2000, 3000, 4000)
    decay_iterations: int = 20000
    rays: int = 8192
    min_views: int = 3
    dense_tv_iterations: int = 0
    voxels_per_pixel: float | None = None
    view_dependence_start: int | None = None
    unbounded_initial_side: float | None = 26
    crop: bool = False
    phases: tuple[CanonicalPhase, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        least = {"search_side": 2, "side": 2}
        least |= dict.fromkeys(("min_views", "iterations", "decay_iterations", "rays"), 1)
        for name, bound in {"search_iterations": 0, "dense_tv_iterations": 0, **least}.items():
            if getattr(self, name) < bound:
                raise DevrfError(
                    f"schedule.canonical.{name}: expected at least {bound}, "
                    f"not {getattr(self, name)}"
                )
        if self.voxels_per_pixel is not None and not 0 < self.voxels_per_pixel <= 4:
            raise DevrfError(
                "schedule.canonical.voxels_per_pixel: expected above 0, at most 4, or null, not "
                f"{self.voxels_per_pixel}"
            )
        if self.view_dependence_start is not None and self.view_dependence_start < 0:
            raise DevrfError(
                "schedule.canonical.view_dependence_start: expected 0 or more, or null, not "
                f"{self.view_dependence_start}"
            )
        if self.unbounded_initial_side is not None and self.unbounded_initial_side < 2:
            raise DevrfError(
                "schedule.canonical.unbounded_initial_side: expected at least 2, or null, not "
                f"{self.unbounded_initial_side}"
            )
        if self.side**3 < 8 * 2 ** len(self.upsample_at):
            raise DevrfError(
                f"schedule.canonical.upsample_at: {len(self.upsample_at)} of them are too many for "
                f"side {self.side}; start from 8 voxels or more"
            )
        edges = [0, *self.upsample_at, self.iterations]
        if any(a >= b for a, b in zip(edges, edges[1:], strict=False)):
            raise DevrfError(
                "schedule.canonical.upsample_at must ascend between 0 and iterations "
                f"({self.iterations}), not {list(self.upsample_at)}"
            )
        offset, phases = self.search_iterations, []
        if offset:
            phases.append(CanonicalPhase("search", 0, offset, self.search_side**3))
        for k, (start, stop) in enumerate(zip(edges, edges[1:], strict=False)):
            voxels = round(self.side**3) // 2 ** (len(self.upsample_at) - k)
            phases.append(CanonicalPhase("fine", offset + start, offset + stop, voxels))
        object.__setattr__(self, "phases", tuple(phases))

    @property
    def total(self) -> int:
        """Iterations of the whole stage."""
        return self.search_iterations + self.iterations

    def phase(self, iteration: int) -> CanonicalPhase:
        """The phase that ``iteration`` belongs to; the last one from the end on."""
        return next((p for p in self.phases if iteration < p.stop), self.phases[-1])

    def smooths_all(self, iteration: int) -> bool:
        """Whether the total variation of ``iteration`` reaches untouched voxels too."""
        return 0 <= iteration - self.search_iterations < self.dense_tv_iterations

    def learns_directions(self, iteration: int) -> bool:
        """Whether ``iteration`` teaches the network what viewing directions change."""
        return iteration - self.search_iterations >= (self.view_dependence_start or 0)

    def in_space(self, space: Space) -> CanonicalSchedule:
        """The same schedule with what contracted space changes (docs/method.md#scene-contraction).

        Sides are longer by the space's factor; ``upsample_at`` and ``view_dependence_start`` are
        filled in.
        """
        if space.is_linear:
            return self
        side, late = self.side * space.side_factor, self.view_dependence_start
        return replace(
            self,
            side=side,
            search_side=round(self.search_side * space.side_factor),
            upsample_at=self._upsampling_from(self.unbounded_initial_side, side),
            view_dependence_start=self.iterations // 2 if late is None else late,
        )

    def _upsampling_from(self, start: float | None, side: float) -> Sequence[int]:
        """Equal intervals between the upsample_at that lead from ``start`` voxels to ``side``."""
        if start is None:
            return self.upsample_at
        count = max(0, round(3 * math.log2(side / start)))
        return tuple(3 * self.iterations * (k + 1) // (4 * count) for k in range(count))

    def learning_rate_factor(self, iteration: int) -> float:
        """0.1^(n / decay_iterations), n from the start of the search or of the radiance field."""
        first = 0 if iteration < self.search_iterations else self.search_iterations
        return float(0.1 ** ((iteration - first) / self.decay_iterations))

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
        carve: begin with the visual hull of the static views, if the images have mattes; then
            the search may be short, or left out.
        iterations: length of the radiance field's learning.
        side: the final grid has about side³ voxels.
        doublings: iterations, from the search's end, at which the number of voxels doubles; it
            starts at side³ / 2^len(doublings).
        decay_iterations: after as many iterations the learning rates have fallen to a tenth.
        rays: of a batch.
        least_views: cells that fewer training views have in the picture are empty from the
            start; 1 keeps those that no camera sees as well.
        dense_tv_iterations: so long, from the search's end, the total variation smooths all
            voxels; afterwards those that a batch has touched.
        voxels_per_pixel: in forward-facing scenes, grid points for each pixel of a row or column;
            decides ``side``. None: ``side`` is as it says.
        directions_from: so many iterations from the search's end colours do not depend on the
            viewing direction. None: 0; in contracted space half of ``iterations``
            (docs/method.md#scene-contraction).
        contracted_start: in contracted space the grid starts with about as many voxels along an
            edge, and doubles at equal intervals over the first three quarters of ``iterations``
            in place of ``doublings``. None: ``doublings`` hold there, too.
        crop: in forward-facing scenes, whether the grid, each time it grows, gives up the depths
            at which the static views see nothing (docs/method.md#crop).
    """

    search_iterations: int = 5000
    search_side: int = 100
    carve: bool = False
    iterations: int = 20000
    side: float = 160
    doublings: Sequence[int] = (1000, 2000, 3000, 4000)
    decay_iterations: int = 20000
    rays: int = 8192
    least_views: int = 3
    dense_tv_iterations: int = 0
    voxels_per_pixel: float | None = None
    directions_from: int | None = None
    contracted_start: float | None = 26
    crop: bool = False
    phases: tuple[CanonicalPhase, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        least = {"search_side": 2, "side": 2}
        least |= dict.fromkeys(("least_views", "iterations", "decay_iterations", "rays"), 1)
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
        if self.directions_from is not None and self.directions_from < 0:
            raise DevrfError(
                "schedule.canonical.directions_from: expected 0 or more, or null, not "
                f"{self.directions_from}"
            )
        if self.contracted_start is not None and self.contracted_start < 2:
            raise DevrfError(
                "schedule.canonical.contracted_start: expected at least 2, or null, not "
                f"{self.contracted_start}"
            )
        if self.side**3 < 8 * 2 ** len(self.doublings):
            raise DevrfError(
                f"schedule.canonical.doublings: {len(self.doublings)} of them are too many for "
                f"side {self.side}; start from 8 voxels or more"
            )
        edges = [0, *self.doublings, self.iterations]
        if any(a >= b for a, b in zip(edges, edges[1:], strict=False)):
            raise DevrfError(
                "schedule.canonical.doublings must ascend between 0 and iterations "
                f"({self.iterations}), not {list(self.doublings)}"
            )
        offset, phases = self.search_iterations, []
        if offset:
            phases.append(CanonicalPhase("search", 0, offset, self.search_side**3))
        for k, (start, stop) in enumerate(zip(edges, edges[1:], strict=False)):
            voxels = round(self.side**3) // 2 ** (len(self.doublings) - k)
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
        return iteration - self.search_iterations >= (self.directions_from or 0)

    def in_space(self, space: Space) -> CanonicalSchedule:
        """The same schedule with what contracted space changes (docs/method.md#scene-contraction).

        Sides are longer by the space's factor; ``doublings`` and ``directions_from`` are filled in.
        """
        if space.is_linear:
            return self
        side, late = self.side * space.side_factor, self.directions_from
        return replace(
            self,
            side=side,
            search_side=round(self.search_side * space.side_factor),
            doublings=self._doublings_from(self.contracted_start, side),
            directions_from=self.iterations // 2 if late is None else late,
        )

    def _doublings_from(self, start: float | None, side: float) -> Sequence[int]:
        """Equal intervals between the doublings that lead from ``start`` voxels to ``side``."""
        if start is None:
            return self.doublings
        count = max(0, round(3 * math.log2(side / start)))
        return tuple(3 * self.iterations * (k + 1) // (4 * count) for k in range(count))

    def learning_rate_factor(self, iteration: int) -> float:
        """0.1^(n / decay_iterations), n from the start of the search or of the radiance field."""
        first = 0 if iteration < self.search_iterations else self.search_iterations
        return float(0.1 ** ((iteration - first) / self.decay_iterations))

"""The schedule of a method that learns from rays: iterations, rays and rates."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Lt
from pydantic.dataclasses import dataclass

from devrf.engine.schedule import Phase
from devrf.errors import expect
from devrf.system.options import Count, Options, Positive, Whole

# What happens in the course of a stage, beside what a method says.
GROWN = "grids grown"


@dataclass(frozen=True)
class RaySchedule(Options):
    """Iterations, rays and rates by which a method learns.

    Of a stage it is a :class:`~devrf.engine.schedule.Schedule`.

    Attributes:
        iterations: of the whole protocol; each of its stages takes a share.
        rays: of a batch.
        rays_without_hull: of a batch where no masks tell which space is empty, so that a ray has
            more samples; None: as many.
        learning_rate: of Adam at the first iteration of a stage.
        learning_rate_without_hull: the same where no masks tell which space is empty, which large
            steps may fill with fog; None: as elsewhere.
        final_learning_rate: at its last; without a hull as many times less as the first.
        decay: of the rate in between: ``exponential``, or half a ``cosine``.
        warmup: share of a stage during which the rate grows evenly from nothing, beside its decay.
        betas: of Adam.
        eps: of Adam.
        curriculum: share of a stage during which frames are added in the order of their times.
        centre_crop: so many first iterations of a stage draw from the images' centre half alone.
        times_per_batch: for a method whose cost grows with them, of a whole batch; of one of both
            captures the static images' time is one of them. None: any number.
        iterations_per_step: optimiser iterations in one Lightning step.
        growths: iterations of a stage at which the method's grids grow, ascending; the stage says.
        milestones: likewise, iterations of what happens once, by name.
    """

    key: ClassVar[str] = "ray_stage.schedule"

    iterations: Count
    rays: Count
    learning_rate: Positive
    final_learning_rate: float
    betas: Sequence[float] = (0.9, 0.999)
    eps: float = 1e-8
    curriculum: Annotated[float, Ge(0), Lt(1)] = 0.0
    centre_crop: Whole = 0
    times_per_batch: Count | None = None
    rays_without_hull: Count | None = None
    learning_rate_without_hull: Positive | None = None
    decay: Literal["exponential", "cosine"] = "exponential"
    warmup: Annotated[float, Ge(0), Lt(1)] = 0.0
    iterations_per_step: Count = 10
    growths: Sequence[int] = ()
    milestones: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        positive = self.final_learning_rate > 0 or self.decay == "cosine"
        expected = "more than 0, or decay=cosine"
        expect(positive, f"{self.key}.final_learning_rate", expected, self.final_learning_rate)

    @property
    def total(self) -> int:
        """Iterations."""
        return self.iterations

    @property
    def planned_events(self) -> Mapping[str, int]:
        """Growths of grids, curricula, and what the method itself does in time."""
        grown = {GROWN: len(self._edges) - 2} if len(self._edges) > 2 else {}
        reached = [name for name, at in self.milestones.items() if at < self.total]
        return {**grown, **dict.fromkeys(reached, 1)}

    @property
    def _edges(self) -> list[int]:
        """The phases' ends."""
        return [0, *(n for n in self.growths if 0 < n < self.total), self.total]

    def phase(self, iteration: int) -> Phase:
        """A phase lasts until the method's grids grow; all else stays as it is."""
        edges = self._edges
        number = min(bisect_right(edges, iteration), len(edges) - 1)
        return Phase(kind="rays", start=edges[number - 1], stop=edges[number])

    def scaled(self, factor: float) -> RaySchedule:
        """As many phases in ``factor`` times the iterations, one each at least."""
        edges = [0]
        for edge in self._edges[1:]:
            edges.append(max(round(edge * factor), edges[-1] + 1))
        return replace(
            self,
            iterations=edges[-1],
            centre_crop=math.ceil(self.centre_crop * factor),
            growths=edges[1:-1],
            milestones={name: round(at * factor) for name, at in self.milestones.items()},
        )

    def learning_rate_factor(self, iteration: int) -> float:
        """At iteration n of N, with ρ = final / initial and x = n / (N − 1), after a warm-up.

        ρ^x, or ρ + (1 − ρ) (1 + cos πx) / 2.
        """
        last = max(self.iterations - 1, 1)
        done = min(iteration, last) / last
        ratio = self.final_learning_rate / self.learning_rate
        warmth = min(1.0, (iteration + 1) / (self.warmup * self.iterations + 1))
        if self.decay == "cosine":
            return warmth * (ratio + (1 - ratio) * (1 + math.cos(math.pi * done)) / 2)
        return float(warmth * ratio**done)

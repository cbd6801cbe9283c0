"""The deformation stage's schedule: a pure map from an iteration to the frames learned then."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Literal

from devrf.errors import DevrfError

# In time, from a visit of a level to the next.
Order = Literal["forward", "backward"]


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
        fall: what it has been multiplied by further at the visit's end.
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
    fall: float
    init_from_previous: bool
    has_previous: bool
    backward: bool = False

    @property
    def kind(self) -> str:
        """The level, in words."""
        return f"level {self.level}"


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
    frame 0 is alone, its share goes to the last frame. A level may have the side of the one before
    it: the same grids are then gone through once more, at the same rate.

    Attributes:
        sides: the motion grids have about side³ voxels at each level, coarse to fine.
        iterations_per_frame: share of a frame at each level.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate, each
            frame starting from rest (``ablation=base``, docs/method.md#ablations).
        decay: factor of the learning rate from a level to the next, if its side is another one.
        rays: of a batch.
        parallel_frames: K of each level, 1 at the coarsest, where a frame starts from the one
            before it; None: 1 throughout.
        order: of the frames of each level, ``forward`` in time at the coarsest; None: ``forward``
            throughout.
        rates: factor of the learning rate at each level; None: ``decay`` to the power of how often
            the side has changed.
        fall: what the learning rate falls to in the course of a visit, exponentially, as a factor,
            at each level; None: 1 throughout.
        factors: of the weights of ``loss.deformation`` at each level, by the term's name; 1
            throughout of terms that are not named.
    """

    sides: Sequence[int] = (10, 20, 40, 80, 160)
    iterations_per_frame: Sequence[int] = (200, 100, 100, 50, 50)
    coarse_to_fine: bool = True
    decay: float = 10 ** (-1 / 4)
    rays: int = 8192
    parallel_frames: Sequence[int] | None = None
    order: Sequence[Order] | None = None
    rates: Sequence[float] | None = None
    fall: Sequence[float] | None = None
    factors: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.sides) != len(self.iterations_per_frame) or not self.sides:
            raise DevrfError(
                "schedule.deformation.sides and .iterations_per_frame must be of one length, "
                f"not {len(self.sides)} and {len(self.iterations_per_frame)}"
            )
        at_once = (1,) * len(self.sides) if self.parallel_frames is None else self.parallel_frames
        if len(at_once) != len(self.sides):
            raise DevrfError(
                f"schedule.deformation.parallel_frames: expected {len(self.sides)} numbers, one "
                f"for each of .sides, or null, not {len(at_once)}"
            )
        for name, values, bound in (
            ("sides", self.sides, 2),
            ("iterations_per_frame", self.iterations_per_frame, 1),
            ("rays", (self.rays,), 1),
            ("parallel_frames", at_once, 1),
        ):
            if min(values) < bound:
                raise DevrfError(
                    f"schedule.deformation.{name}: expected at least {bound}, not {min(values)}"
                )
        if not self.decay > 0:
            raise DevrfError(f"schedule.deformation.decay: expected more than 0, not {self.decay}")
        if self.coarse_to_fine and at_once[0] > 1:
            raise DevrfError(
                "schedule.deformation.parallel_frames: expected 1 at the first level, where a "
                f"frame starts from the one before it, not {at_once[0]}"
            )
        self._check_order()
        self._check_factors()
        if not self.coarse_to_fine:
            object.__setattr__(self, "sides", (self.sides[-1],))
            object.__setattr__(self, "iterations_per_frame", (sum(self.iterations_per_frame),))
            object.__setattr__(self, "parallel_frames", (at_once[-1],))
            object.__setattr__(self, "order", None)
            object.__setattr__(self, "rates", None)
            object.__setattr__(self, "fall", None if self.fall is None else (self.fall[-1],))
            last = {name: (factors[-1],) for name, factors in self.factors.items()}
            object.__setattr__(self, "factors", last)

    def _check_order(self) -> None:
        order = self.order
        if order is None:
            return
        if len(order) != len(self.sides) or not set(order) <= {"forward", "backward"}:
            raise DevrfError(
                "schedule.deformation.order: expected forward or backward for each of .sides, or "
                f"null, not {list(order)}"
            )
        if order[0] != "forward":
            raise DevrfError(
                "schedule.deformation.order: expected forward at the first level, where a frame "
                f"starts from the one before it, not {order[0]}"
            )

    def _check_factors(self) -> None:
        given = {"rates": self.rates, "fall": self.fall}
        of_terms = {f"factors.{name}": factors for name, factors in self.factors.items()}
        for name, factors in {**given, **of_terms}.items():
            if factors is None:
                continue
            # A weight may be 0, a rate may not.
            too_low = min(factors, default=0) < 0 or (name in given and 0 in factors)
            if len(factors) != len(self.sides) or too_low:
                least = "above 0" if name in given else "at least 0"
                raise DevrfError(
                    f"schedule.deformation.{name}: expected a number, {least}, for each of .sides, "
                    f"not {list(factors)}"
                )

    def learning_rate_factor(self, level: int) -> float:
        """Factor of the learning rate when a visit of ``level`` begins."""
        if self.rates is not None:
            return self.rates[level]
        return self.decay ** sum(a != b for a, b in pairwise(self.sides[: level + 1]))

    def weight_factor(self, term: str, level: int) -> float:
        """Factor of the weight of a loss term at ``level``."""
        return self.factors[term][level] if term in self.factors else 1.0

    def visits(self, level: int, frames: int) -> int:
        """L of T = ``frames`` frames: visits of a level, and the distance of parallel frames."""
        at_once = 1 if self.parallel_frames is None else self.parallel_frames[level]
        return max(2, -(-frames // at_once))

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
        shares = enumerate(self.iterations_per_frame)
        return [share * self.visits(level, frames) for level, share in shares]

    def phase(self, iteration: int, frames: int) -> DeformationPhase:
        """The visit that ``iteration`` belongs to; the last one from the end on."""
        begins = [0, *self.growths(frames)]
        level = bisect_right(begins, iteration) - 1
        begin, apart = begins[level], self.visits(level, frames)
        share = self.iterations_per_frame[level]
        first = 1 if apart == frames else 0  # frame 0 alone
        visit = min(max((iteration - begin) // share, first), apart - 1)
        backward = self.order is not None and self.order[level] == "backward"
        place = first + apart - 1 - visit if backward else visit
        visited = tuple(range(place or apart, frames, apart))
        return DeformationPhase(
            level=level,
            frames=visited,
            start=begin + (0 if visit == first else visit * share),
            stop=begin + (visit + 1) * share,
            side=self.sides[level],
            learning_rate_factor=self.learning_rate_factor(level),
            fall=1.0 if self.fall is None else self.fall[level],
            init_from_previous=self.coarse_to_fine and level == 0 and visit > 1,
            has_previous=visit > 0 and not backward,
            backward=backward,
        )

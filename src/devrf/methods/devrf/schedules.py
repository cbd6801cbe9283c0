"""Schedules: pure maps from an iteration to what is learned then, and how."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Literal

from devrf.errors import DevrfError


@dataclass(frozen=True)
class CanonicalPhase:
    """A stretch of the canonical stage with one grid.

    Attributes:
        kind: ``search`` for the coarse geometry, ``fine`` for the radiance field.
        start: first iteration.
        stop: one past the last iteration.
        voxels: about how many voxels the grids have.
    """

    kind: Literal["search", "fine"]
    start: int
    stop: int
    voxels: int


@dataclass(frozen=True)
class CanonicalSchedule:
    """The canonical stage's course (method §2); the defaults are the paper's, inward-facing.

    Attributes:
        search_iterations: length of the coarse geometry search; 0 leaves it out.
        search_side: side of the search grid: it has about side³ voxels.
        carve: start from the visual hull of the static views where the images have mattes;
            then the search sees little empty space and may be short, or left out.
        iterations: length of the fine stage.
        side: side of the final grid of about side³ voxels.
        doublings: iterations of the fine stage at which the number of voxels doubles; it starts
            at side³ / 2^len(doublings).
        decay_iterations: every so many iterations the learning rates fall to a tenth.
        rays: rays a batch.
    """

    search_iterations: int = 5000
    search_side: int = 100
    carve: bool = False
    iterations: int = 20000
    side: float = 160
    doublings: Sequence[int] = (1000, 2000, 3000, 4000)
    decay_iterations: int = 20000
    rays: int = 8192
    phases: tuple[CanonicalPhase, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        least = {
            "search_iterations": 0,
            "search_side": 2,
            "iterations": 1,
            "side": 2,
            "decay_iterations": 1,
            "rays": 1,
        }
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise DevrfError(
                    f"schedule.canonical.{name}: expected at least {bound}, "
                    f"not {getattr(self, name)}"
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

    def learning_rate_factor(self, iteration: int) -> float:
        """0.1^(n / decay_iterations), n counted from the start of the search or fine part."""
        searching = iteration < self.search_iterations
        since = iteration if searching else iteration - self.search_iterations
        return float(0.1 ** (since / self.decay_iterations))


@dataclass(frozen=True)
class DeformationPhase:
    """A visit to one frame at one resolution, or to several side by side.

    Attributes:
        level: 0 is the coarsest resolution.
        frames: the frames that are learned, from 1 on, ascending.
        start: first iteration.
        stop: one past the last iteration.
        side: side of the motion grid: it has about side³ voxels.
        learning_rate_factor: what the learning rate is multiplied by.
        carries: whether the frame starts from the result of the frame before it.
        follows: whether the frames before these have been learned at this level, or are at rest.
    """

    level: int
    frames: tuple[int, ...]
    start: int
    stop: int
    side: int
    learning_rate_factor: float
    carries: bool
    follows: bool

    @property
    def in_words(self) -> str:
        """The frames: ``frame 3``, or ``frames 3, 10``."""
        noun = "frame" if len(self.frames) == 1 else "frames"
        return f"{noun} {', '.join(str(frame) for frame in self.frames)}"


@dataclass(frozen=True)
class DeformationSchedule:
    """The deformation stage's course (method §3); the defaults are the paper's, inward-facing.

    Within a level the frames are visited one after another. A level has one share of
    iterations for each of T frames; frame 0 is the identity and needs none, so frame 1 takes
    its share beside its own: the level's length is share · T.

    Where K frames may be learned at once the T frames are cut into contiguous stretches of
    L = ⌈T / K⌉, but of two at least: neighbours are never learned at once. (The last stretch may be
    shorter, and there may be fewer than K.) The j-th visit of the level, 0 ≤ j < L, is to the j-th
    frame of each: frames j, j + L, j + 2L, … An iteration is one optimiser step on all of them,
    each with a batch of its own, so the level's length is share · L. But for the first of a
    stretch, the frame before has been learned at this level by then; the first of a stretch knows
    what the level before has made of its neighbour. Frame 0 is left out. Where that leaves the
    first visit empty, for there is one stretch, frame 1 has its share as said.

    Attributes:
        sides: sides of the motion grids, coarse to fine.
        iterations_per_frame: share of a frame at each level.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate, each
            frame starting from rest (the ``base`` row of the ablation tables).
        decay: factor of the learning rate from a level to the next.
        rays: rays a batch.
        parallel_frames: K of each level, 1 at the coarsest, where a frame starts from the one
            before it; None: 1 throughout.
    """

    sides: Sequence[int] = (10, 20, 40, 80, 160)
    iterations_per_frame: Sequence[int] = (200, 100, 100, 50, 50)
    coarse_to_fine: bool = True
    decay: float = 10 ** (-1 / 4)
    rays: int = 8192
    parallel_frames: Sequence[int] | None = None

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
        if not self.coarse_to_fine:
            object.__setattr__(self, "sides", (self.sides[-1],))
            object.__setattr__(self, "iterations_per_frame", (sum(self.iterations_per_frame),))
            object.__setattr__(self, "parallel_frames", (at_once[-1],))

    def visits(self, level: int, frames: int) -> int:
        """L: in how many visits a level goes through T = ``frames`` frames, the idle one counted.

        Also how many frames lie between two that are visited together.
        """
        at_once = 1 if self.parallel_frames is None else self.parallel_frames[level]
        return max(2, -(-frames // at_once))

    def beside(self, level: int, frames: int) -> int:
        """The most of T = ``frames`` frames that are visited together at a level."""
        return len(range(1, frames, self.visits(level, frames)))

    def total(self, frames: int) -> int:
        """Iterations of the whole stage for T = ``frames`` frames, the rest frame counted."""
        return sum(self._lengths(frames))

    def growths(self, frames: int) -> list[int]:
        """Iterations at which the motion grid grows."""
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
        visited = tuple(range(visit or apart, frames, apart))
        return DeformationPhase(
            level=level,
            frames=visited,
            start=begin + (0 if visit == first else visit * share),
            stop=begin + (visit + 1) * share,
            side=self.sides[level],
            learning_rate_factor=self.decay**level,
            carries=self.coarse_to_fine and level == 0 and visit > 1,
            follows=visit > 0,
        )

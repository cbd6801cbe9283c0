"""Schedules: pure maps from an iteration to what is learned then, and how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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
        least = {"search_iterations": 0, "search_side": 2, "iterations": 1, "side": 2,
                 "decay_iterations": 1, "rays": 1}
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
    """A visit to one frame at one resolution.

    Attributes:
        level: 0 is the coarsest resolution.
        frame: the frame that is learned, from 1 on.
        start: first iteration.
        stop: one past the last iteration.
        side: side of the motion grid: it has about side³ voxels.
        learning_rate_factor: what the learning rate is multiplied by.
        carries: whether the frame starts from the result of the frame before it.
    """

    level: int
    frame: int
    start: int
    stop: int
    side: int
    learning_rate_factor: float
    carries: bool


@dataclass(frozen=True)
class DeformationSchedule:
    """The deformation stage's course (method §3); the defaults are the paper's, inward-facing.

    Within a level the frames are visited one after another. A level has one share of
    iterations for each of T frames; frame 0 is the identity and needs none, so frame 1 takes
    its share beside its own: the level's length is share · T.

    Attributes:
        sides: sides of the motion grids, coarse to fine.
        iterations_per_frame: share of a frame at each level.
        coarse_to_fine: False spends all shares at the finest resolution, at the base rate, each
            frame starting from rest (the ``base`` row of the ablation tables).
        decay: factor of the learning rate from a level to the next.
        rays: rays a batch.
    """

    sides: Sequence[int] = (10, 20, 40, 80, 160)
    iterations_per_frame: Sequence[int] = (200, 100, 100, 50, 50)
    coarse_to_fine: bool = True
    decay: float = 10 ** (-1 / 4)
    rays: int = 8192

    def __post_init__(self) -> None:
        if len(self.sides) != len(self.iterations_per_frame) or not self.sides:
            raise DevrfError(
                "schedule.deformation.sides and .iterations_per_frame must be of one length, "
                f"not {len(self.sides)} and {len(self.iterations_per_frame)}"
            )
        for name, values, bound in (
            ("sides", self.sides, 2),
            ("iterations_per_frame", self.iterations_per_frame, 1),
            ("rays", (self.rays,), 1),
        ):
            if min(values) < bound:
                raise DevrfError(
                    f"schedule.deformation.{name}: expected at least {bound}, not {min(values)}"
                )
        if not self.decay > 0:
            raise DevrfError(f"schedule.deformation.decay: expected more than 0, not {self.decay}")
        if not self.coarse_to_fine:
            object.__setattr__(self, "sides", (self.sides[-1],))
            object.__setattr__(self, "iterations_per_frame", (sum(self.iterations_per_frame),))

    def total(self, frames: int) -> int:
        """Iterations of the whole stage for T = ``frames`` frames, the rest frame counted."""
        return sum(self.iterations_per_frame) * frames

    def growths(self, frames: int) -> list[int]:
        """Iterations at which the motion grid grows."""
        ends, end = [], 0
        for share in self.iterations_per_frame[:-1]:
            end += share * frames
            ends.append(end)
        return ends

    def phase(self, iteration: int, frames: int) -> DeformationPhase:
        """The visit that ``iteration`` belongs to; the last one from the end on."""
        start, level = 0, 0
        while level + 1 < len(self.sides):
            length = self.iterations_per_frame[level] * frames
            if iteration < start + length:
                break
            start += length
            level += 1
        share = self.iterations_per_frame[level]
        frame = min(max((iteration - start) // share, 1), frames - 1)
        return DeformationPhase(
            level=level,
            frame=frame,
            start=start + (0 if frame == 1 else frame * share),
            stop=start + (frame + 1) * share,
            side=self.sides[level],
            learning_rate_factor=self.decay**level,
            carries=self.coarse_to_fine and level == 0 and frame > 1,
        )

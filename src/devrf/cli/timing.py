"""How long things take: what is measured, and how thoroughly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from devrf.cli.roofline import Work
from devrf.errors import DevrfError


@dataclass(frozen=True)
class BenchmarkSettings:
    """How thoroughly a scene is measured.

    Attributes:
        warmup: Lightning steps at each resolution before anything is measured.
        repeats: how many steps are measured undisturbed, and how many part by part.
        training: share of the schedule that is learned first where no checkpoint is found.
        views: held-out views that are rendered.
    """

    warmup: int = 1
    repeats: int = 3
    training: float = 0.2
    views: int = 5

    def __post_init__(self) -> None:
        for name, least in (("warmup", 0), ("repeats", 1), ("views", 1)):
            if getattr(self, name) < least:
                raise DevrfError(
                    f"benchmark.{name}: expected at least {least}, not {getattr(self, name)}"
                )
        if not 0 < self.training <= 1:
            raise DevrfError(
                f"benchmark.training: expected more than 0 and at most 1, not {self.training}"
            )


@dataclass(frozen=True)
class Spread:
    """Values of several repeats: the middle one, the lowest, the highest.

    Attributes:
        median: the middle one.
        low: the lowest.
        high: the highest.
    """

    median: float
    low: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        return Spread(median(values), min(values), max(values))


@dataclass(frozen=True)
class Timing:
    """What an iteration takes at one resolution.

    Attributes:
        stage: ``canonical`` or ``deformation``.
        phase: ``search``, ``fine``, or the level's number.
        resolution: shape of the grid that is learned.
        frames: the frames that were visited; none in the canonical stage.
        rays: rays of an iteration.
        iterations: how many a repeat covers.
        seconds: of an iteration that nobody disturbs.
        measured_seconds: of an iteration whose parts are measured.
        parts: seconds by part of such an iteration.
        counts: samples of an iteration by what became of them.
        work: the least that an iteration has to do; None where samples were not counted.
        allocated: bytes of the GPU in use at the worst moment; None on a CPU.
        reserved: bytes of the GPU held then; None on a CPU.
    """

    stage: str
    phase: str
    resolution: tuple[int, int, int]
    frames: tuple[int, ...]
    rays: int
    iterations: int
    seconds: Spread
    measured_seconds: Spread
    parts: Mapping[str, Spread]
    counts: Mapping[str, float]
    work: Work | None
    allocated: int | None
    reserved: int | None


@dataclass(frozen=True)
class PictureTiming:
    """What a picture of a held-out view takes.

    Attributes:
        width: in pixels.
        height: in pixels.
        views: how many were rendered.
        new: seconds of a picture at a time that nothing is known of yet.
        again: seconds of another picture at the same time.
        difference: the largest difference between a colour, in [0, 1], and what the first way
            of rendering gave there; 0 for the first way itself.
    """

    width: int
    height: int
    views: int
    new: Spread
    again: Spread
    difference: float

"""What a run needs beside what there is: whether it can be, in one line."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from devrf.cli.memory import PROGRAM, Budget, StageMemory
from devrf.errors import DevrfError
from devrf.system.out_of_memory import gib

# The keys that a part's size depends on, by words of its name, as `estimate` calls it.
KEYS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("images", "flow", "depth", "pixels"), ("data.downscale", "data.width", "data.frames")),
    (("side by side",), ("schedule.deformation.parallel_frames", "schedule.deformation.sides")),
    (("displacements", "frame", "growing"), ("schedule.deformation.sides", "data.frames")),
    (
        ("density", "gradients", "moments", "step", "copy", "occup", "decoder"),
        ("schedule.canonical.side",),
    ),
)


@dataclass(frozen=True)
class Requirement:
    """How much of something is needed, and how much there is.

    Attributes:
        what: in words: ``host memory``.
        needed: bytes.
        there: bytes that can be had; None where nobody knows.
        least: bytes that it takes in hard times: where less is there, it cannot be.
        keys: config keys that it depends on, those that matter most first.
    """

    what: str
    needed: int
    there: int | None
    least: int
    keys: Sequence[str]

    @property
    def possible(self) -> bool:
        """Whether it can be, if need be in hard times."""
        return fits(self.least, self.there)

    def __str__(self) -> str:
        there = "an unknown amount" if self.there is None else f"{gib(self.there)} GiB"
        return f"{gib(self.needed)} of {there} of {self.what}"


def fits(needed: int, there: int | None, spare: float = 0.0) -> bool:
    """Whether ``needed`` bytes are there, with a share of them to spare; True if unknown.

    Args:
        needed: bytes that will be needed, as estimated.
        there: bytes that can be had (``system.machine.free_memory``); None where nobody knows.
        spare: how much more must be there, as a share of ``needed``: estimates err.
    """
    return there is None or needed * (1 + spare) <= there


def gpu_need(budget: Budget, stages: Collection[str], there: int | None) -> Requirement:
    """The GPU memory that the larger of some stages needs.

    Args:
        budget: of the run.
        stages: ``canonical``, ``deformation`` or both.
        there: bytes free on the GPU.
    """
    stage = max(_stages(budget, stages), key=lambda one: one.peak)
    keys = keys_of(_parts(stage), stages)
    return Requirement("GPU memory", stage.peak, there, stage.least, keys)


def host_need(
    budget: Budget,
    stages: Collection[str],
    there: int | None,
    *,
    alone: bool,
    scores: bool,
    processes: int = 1,
) -> Requirement:
    """The host memory that some stages need.

    Args:
        budget: of the run.
        stages: which learn.
        there: bytes free on the host, and what this process holds already.
        alone: whether the stages work on the host, not on a GPU.
        scores: whether the run also scores and films, which takes the fields twice.
        processes: how many learn together on this machine; each has its own scene.
    """
    working = max(_stages(budget, stages), key=lambda one: one.on_host)
    fields = sum(budget.fields.values())
    # Fields on a GPU come to the host to be written.
    own = working.on_host if alone else fields
    together = processes * (PROGRAM + sum(budget.scene.values()) + own)
    needed = max(together, budget.host if scores else 0)
    parts = {**budget.scene, **(_parts(working) if alone else budget.fields)}
    return Requirement("host memory", needed, there, needed, keys_of(parts, stages))


def disk_need(
    budget: Budget, stages: Collection[str], there: int | None, *, kept: int, films: int = 0
) -> Requirement:
    """The room on the disk for the checkpoints of some stages, progress files, and videos.

    Args:
        budget: of the run.
        stages: which learn, in any order.
        there: bytes free, and what files of theirs take that will be replaced.
        kept: progress files that are kept.
        films: bytes of the videos.
    """
    files = [budget.files[name] for name in ("canonical", "deformation") if name in stages]
    written = [sum(f.finished for f in files[:k]) + files[k].peak(kept) for k in range(len(files))]
    needed = max(*written, sum(f.finished for f in files) + films)
    return Requirement("disk", needed, there, needed, keys_of(budget.checkpoint, stages))


def keys_of(parts: Mapping[str, int], stages: Collection[str]) -> list[str]:
    """The config keys that parts of a memory depend on, those of the largest first."""
    found: dict[str, None] = {}
    for name, _ in sorted(parts.items(), key=lambda part: -part[1]):
        words = next((keys for marks, keys in KEYS if any(mark in name for mark in marks)), None)
        found.update(dict.fromkeys(words or (f"schedule.{s}.rays" for s in sorted(stages))))
    return list(found)


def check(needs: Sequence[Requirement], known: Collection[str]) -> str:
    """What is needed, in one line.

    Args:
        needs: memory and disk.
        known: the config keys that there are.

    Raises:
        DevrfError: something cannot be.
    """
    said = f"needs about {', '.join(str(need) for need in needs)}"
    for need in needs:
        if not need.possible:
            keys = [key for key in need.keys if key in known][:4]
            raise DevrfError(
                f"{keys[0] if keys else 'data'}: the run {said}; it would end for lack of "
                f"{need.what}: change {', '.join(keys)}, or try all the same with "
                "memory_check=false"
            )
    short = [need.what for need in needs if not fits(need.needed, need.there)]
    return f"{said}; batches will be taken in parts, slower" if short else said


def _stages(budget: Budget, names: Collection[str]) -> list[StageMemory]:
    both = {"canonical": budget.canonical, "deformation": budget.deformation}
    return [both[name] for name in both if name in names]


def _parts(stage: StageMemory) -> Mapping[str, int]:
    """What is held, and the largest of what passes."""
    worst = max(stage.passing, key=lambda name: stage.passing[name])
    return {**stage.held, worst: stage.passing[worst]}

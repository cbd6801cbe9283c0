"""What is needed and what is there, compared by hand."""

from __future__ import annotations

import pytest

from devrf.cli.memory import BATCH, PROGRAM, Budget, StageFiles, StageMemory
from devrf.cli.requirements import Requirement, check, disk_need, fits, gpu_need, host_need, keys_of
from devrf.errors import DevrfError

GIB = 2**30
BUDGET = Budget(
    scene={"images": 100},
    canonical=StageMemory({"images": 60, "density and features": 400}, {BATCH: 1600}),
    deformation=StageMemory(
        {"images": 40, "displacements of 5 frames, both ways": 1000}, {BATCH: 800}
    ),
    fields={"density and features": 400, "displacements of 5 frames, both ways": 1000},
    checkpoint={"density and features": 400, "displacements of 5 frames, both ways": 1000},
    files={"canonical": StageFiles(400, 1200), "deformation": StageFiles(1400, 1500)},
)
BOTH = ("canonical", "deformation")


def test_what_fits() -> None:
    assert fits(100, 100) and not fits(101, 100) and fits(10**20, None)
    assert fits(128, 160, spare=0.25) and not fits(128, 159, spare=0.25)


def test_a_gpu_needs_the_larger_stage() -> None:
    need = gpu_need(BUDGET, BOTH, 5000)
    assert (need.needed, need.least, need.there) == (2060, 660, 5000)
    assert need.keys[0] == "schedule.canonical.rays"
    need = gpu_need(BUDGET, ("deformation",), None)
    assert (need.needed, need.least) == (1840, 1140)
    assert need.keys[:2] == ["schedule.deformation.sides", "data.frames"]


def test_a_host_needs_program_scene_and_stage() -> None:
    alone = host_need(BUDGET, BOTH, None, alone=True, scores=False)
    # What the stage holds beside the images, and what malloc keeps of it.
    assert alone.needed == alone.least == PROGRAM + 100 + 2600
    two = host_need(BUDGET, BOTH, None, alone=True, scores=False, processes=2)
    assert two.needed == 2 * alone.needed
    beside = host_need(BUDGET, BOTH, None, alone=False, scores=True)
    assert beside.needed == PROGRAM + 100 + 2 * 1400
    assert host_need(BUDGET, BOTH, None, alone=False, scores=False).needed == PROGRAM + 100 + 1400


def test_a_disk_needs_what_is_there_at_once() -> None:
    # Three progress files of the deformation beside the canonical checkpoint.
    assert disk_need(BUDGET, BOTH, None, kept=2).needed == 400 + 3 * 1500
    assert disk_need(BUDGET, ("canonical",), None, kept=2).needed == 3 * 1200
    assert disk_need(BUDGET, BOTH, None, kept=2, films=9000).needed == 400 + 1400 + 9000


def test_frames_side_by_side_may_be_fewer() -> None:
    parts = {"gradients of 4 frames side by side": 9, "displacements of 50 frames, both ways": 5}
    assert keys_of(parts, ("deformation",)) == [
        "schedule.deformation.parallel_frames",
        "schedule.deformation.sides",
        "data.frames",
    ]


def test_keys_of_the_largest_part_come_first() -> None:
    parts = {"images": 10, "density and features": 30, "a batch": 20}
    assert keys_of(parts, ("canonical",)) == [
        "schedule.canonical.side",
        "schedule.canonical.rays",
        "data.downscale",
        "data.width",
        "data.frames",
    ]


def need(what: str, needed: float, there: float | None, least: float) -> Requirement:
    known = None if there is None else round(there * GIB)
    return Requirement(
        what, round(needed * GIB), known, round(least * GIB), ["data.frames", "data.width"]
    )


def test_a_budget_in_one_line() -> None:
    needs = [need("host memory", 1.2, 21.3, 1.2), need("disk", 0.25, None, 0.25)]
    assert check(needs, ()) == (
        "needs about 1.2 of 21.3 GiB of host memory, 0.25 of an unknown amount of disk"
    )


def test_where_only_whole_batches_are_too_large_the_run_may_begin() -> None:
    said = check([need("GPU memory", 9.0, 8.0, 3.0)], ())
    assert said.endswith("9.0 of 8.0 GiB of GPU memory; batches will be taken in parts, slower")


def test_what_cannot_be_is_refused_with_numbers_and_keys() -> None:
    needs = [need("GPU memory", 2.0, 8.0, 1.0), need("host memory", 30.1, 21.3, 30.1)]
    with pytest.raises(DevrfError) as caught:
        check(needs, {"data.width", "seed"})
    assert str(caught.value) == (
        "data.width: the run needs about 2.0 of 8.0 GiB of GPU memory, 30.1 of 21.3 GiB of host "
        "memory; it would end for lack of host memory: change data.width, or try all the same "
        "with memory_check=false"
    )

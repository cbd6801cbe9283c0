"""A run says what it needs, refuses what cannot be, and lives with little memory."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

import pytest
import torch

from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.cli import preflight
from devrf.cli.preflight import Requirement, check
from devrf.errors import DevrfError

GIB = 2**30
linux = pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux limits and counts it")
NEEDS = re.compile(
    r"needs about ([\d.]+) of [\d.]+ GiB of host memory, ([\d.]+) of [\d.]+ GiB of disk"
)


def need(what: str, needed: float, there: float, least: float | None = None) -> Requirement:
    """A requirement in GiB."""
    parts = {("data.frames", "data.width"): 3, ("data.rays",): 5, ("data.unused",): 0}
    least = needed if least is None else least
    return Requirement(what, *(round(n * GIB) for n in (needed, there)), parts, round(least * GIB))


def test_needs_in_one_line() -> None:
    needs = [need("host memory", 1.2, 21.3), need("disk", 0.25, 8)]
    assert (
        check(needs, bool) == "needs about 1.2 of 21.3 GiB of host memory, 0.25 of 8.0 GiB of disk"
    )


def test_where_only_whole_batches_are_too_large_the_run_may_begin() -> None:
    said = check([need("GPU memory", 9.0, 8.0, least=3.0)], bool)
    assert said.endswith("9.0 of 8.0 GiB of GPU memory; batches will be taken in parts, slower")


def test_what_cannot_suffice_is_refused_with_numbers_and_keys() -> None:
    needs = [need("GPU memory", 2.0, 8.0), need("host memory", 30.1, 21.3)]
    assert needs[0].keys == ["data.rays", "data.frames", "data.width"]
    with pytest.raises(DevrfError) as caught:
        check(needs, {"data.width", "data.rays"}.__contains__)
    assert str(caught.value) == (
        "data.rays: the run needs about 2.0 of 8.0 GiB of GPU memory, 30.1 of 21.3 GiB of host "
        "memory; it would end for lack of host memory: change data.rays, data.width, or try all "
        "the same with memory_check=false"
    )


def test_the_budget_is_told_first(trained) -> None:
    lines = trained[1].out.splitlines()
    said = [k for k, line in enumerate(lines) if NEEDS.search(line)]
    assert len(said) == 1
    assert said[0] < next(k for k, line in enumerate(lines) if "fields live in" in line)


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["schedule.deformation.levels.2.side=2000"], "schedule.deformation.levels"),
        (["schedule.canonical.side=3000"], "schedule.canonical.side"),
        (["schedule.canonical.rays=1000000000"], "schedule.canonical.rays"),
        (["stage=canonical", "schedule.canonical.side=3000"], "schedule.canonical.side"),
    ],
)
def test_what_cannot_be_is_refused_before_it_begins(devrf, tiny, tmp_path, arguments, key) -> None:
    outcome = devrf(*tiny, *arguments, "hydra.run.dir=run")
    assert outcome.status == 2
    assert outcome.err.startswith(f"devrf: {key}: the run needs about ")
    assert outcome.err.count("\n") == 1 and "memory_check=false" in outcome.err
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_full_disk_is_noticed_before_it_begins(devrf, tiny, monkeypatch) -> None:
    monkeypatch.setattr(preflight, "free_disk", lambda folder: 1000)
    outcome = devrf(*tiny)
    assert outcome.status == 2
    assert re.search(r" of 9.3e-07 GiB of disk; it would end for lack of disk", outcome.err)


def test_little_memory_refuses_what_is_not_finished_and_changes_nothing(
    devrf, tiny, monkeypatch, tmp_path
) -> None:
    command = (*tiny, "stage=canonical", "hydra.run.dir=run")
    monkeypatch.setattr(preflight, "free_host_memory", lambda: -(10**12))
    outcome = devrf(*command)
    assert outcome.status == 2 and "lack of host memory" in outcome.err
    assert not (tmp_path / "run").exists()
    assert devrf(*command, "memory_check=false").status == 0
    # What is learned already needs nothing.
    assert devrf(*command).status == 0
    assert devrf(*command, "resume=false").status == 2
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert not (tmp_path / "run" / "previous-1").exists()


def test_running_out_of_memory_is_one_line(devrf, tiny, monkeypatch) -> None:
    def enter(stage: object, phase: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB.")

    monkeypatch.setattr("devrf.methods.devrf.canonical_stage.CanonicalStage.enter", enter)
    outcome = devrf(*tiny)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: stage=canonical: out of memory (3.0 GiB more asked, ")
    assert "lower schedule.canonical.side or schedule.canonical.rays" in outcome.err


def canonical_colors(folder: Path) -> torch.Tensor:
    content = read_checkpoint_file(folder / "run" / "checkpoints" / "canonical.ckpt")
    colors: torch.Tensor = content["state_dict"]["scene_model.canonical.color.values"]
    return colors


# Half of the fields and a small part of a batch fit into the memory left to the program.
LARGE = (
    "schedule.canonical.rays=60000",
    "schedule.canonical.iterations=2",
    "schedule.canonical.upsample_at=[]",
    "stage=canonical",
    "hydra.run.dir=run",
)


@linux
def test_a_stage_learns_in_parts_where_memory_is_short(warm, tiny, tmp_path) -> None:
    outcome = warm(tmp_path, *tiny, *LARGE, most_memory=300 * 2**20)
    assert outcome.status == 0, outcome.out
    assert re.search(r"out of memory \(.*: batches are taken in \d parts from now on", outcome.out)
    outcome = warm(tmp_path / "free", *tiny, *LARGE)
    assert outcome.status == 0 and "out of memory" not in outcome.out
    limited, free = canonical_colors(tmp_path), canonical_colors(tmp_path / "free")
    torch.testing.assert_close(limited, free, rtol=1e-3, atol=1e-4)


@linux
def test_a_stage_that_not_even_parts_fit_for_ends_saved(warm, tiny, tmp_path) -> None:
    command = (*tiny, *LARGE, "schedule.canonical.rays=400000")
    outcome = warm(tmp_path, *command, most_memory=200 * 2**20)
    assert outcome.status == 2, outcome.out
    said = outcome.out.splitlines()[-1]
    assert said.startswith("devrf: canonical stage: out of memory (") and " GiB free on cpu" in said
    assert "schedule.canonical.rays" in said and "the same command goes on" in said
    assert list((tmp_path / "run" / "checkpoints").glob("canonical-progress-*.ckpt"))


# The sizes of stages, and how many pixels their images have.
SIZES = {
    "small": (
        "data.width=48",
        "data.height=48",
        "schedule.canonical.side=32",
        "schedule.canonical.rays=1024",
        "schedule.canonical.iterations=4",
        "schedule.canonical.upsample_at=[1]",
        "schedule.deformation.levels.1={side:8,iterations:1}",
        "schedule.deformation.levels.2={side:24,iterations:1}",
        "schedule.deformation.rays=1024",
    ),
    "large": (
        "data.width=96",
        "data.height=96",
        "data.frames=2",
        "schedule.canonical.side=80",
        "schedule.canonical.rays=4096",
        "schedule.canonical.iterations=2",
        "schedule.canonical.upsample_at=[1]",
        "schedule.deformation.levels.1={side:56,iterations:1}",
        "schedule.deformation.levels.2=null",
        "schedule.deformation.rays=4096",
    ),
}


@linux
@pytest.mark.parametrize("size", SIZES)
def test_the_estimate_is_near_what_is_taken(warm, tiny, tmp_path, size) -> None:
    command = (
        *tiny,
        "field.width=128",
        *SIZES[size],
        "hydra.run.dir=run",
        "video.frames=1",
        "video.height=40",
        "evaluation.metrics=[]",
        "callbacks.checkpoint.every_seconds=0",
        "callbacks.checkpoint.share=1.0",
        "trainer.log_every_n_steps=1",
    )
    for stage in ("canonical", "deformation"):
        outcome = warm(tmp_path, *command, f"stage={stage}")
        assert outcome.status == 0, outcome.out
        found = NEEDS.search(outcome.out)
        assert found is not None
        path = tmp_path / "run" / "logs" / stage / "metrics.csv"
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        column = next(name for name in rows[0] if name.endswith("/peak_host_gb"))
        taken = max(float(row[column]) for row in rows)
        assert 0.7 < float(found.group(1)) / taken < 1.5, (stage, found.group(1), taken)

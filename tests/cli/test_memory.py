"""A run says what it needs, refuses what cannot be, and lives with little memory."""

from __future__ import annotations

import csv
import json
import re
import sys

import pytest
import torch

from devrf.apps import fitting
from devrf.apps.needs import smaller
from devrf.engine.needs import StageNeeds, tensor_bytes
from devrf.scenes import image_folders
from devrf.scenes.scene import Scene

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux limits and counts it")
NEEDS = re.compile(
    r"needs about ([\d.]+) of [\d.]+ GiB of host memory, ([\d.]+) of [\d.]+ GiB of disk"
)


def test_what_is_needed_by_hand(tiny_scene: Scene) -> None:
    stage = StageNeeds({"images": 50, "grid": 100, "schedule.rays": 800}, 40)
    assert (stage.peak(), stage.peak(0.5)) == (950, 550)
    moving = tiny_scene.dynamic.train
    assert moving.flow is not None
    assert tensor_bytes(moving.flow) == (2 * 4 + 1) * len(moving) * 24 * 18


def test_the_least_change_by_hand(tiny_scene: Scene) -> None:
    """100 bytes of images made smaller by 2, and a grid of side 4, 64 bytes."""

    def change(free: float) -> tuple[str, int] | None:
        def suffices(key: str, value: int) -> bool:
            images, side = (value, 4) if key == fitting.SIZE else (2, value)
            return 100 * (2 / images) ** 2 + side**3 <= free

        parts = {"side": 64.0, fitting.SIZE: 100.0}
        return fitting.least_change(parts, {"side": 4, fitting.SIZE: 2}, suffices)

    # By 3 images take 44 bytes, by 16, the most, 1.6; a side of 3 takes 27.
    assert change(125) == (fitting.SIZE, 3)
    assert change(65) is None and change(66) == (fitting.SIZE, 15)
    pixels = smaller(tiny_scene, 1.5).static.train.pixels
    assert pixels.shape == (len(tiny_scene.static.train), 12, 16, 4)


def test_the_size_that_was_chosen_stays(devrf, tiny_data, short, tmp_path, monkeypatch) -> None:
    assert devrf(*tiny_data, "stage=prepare", "data.export=scene").status == 0
    monkeypatch.setattr(image_folders, "LEAST_SIDE", 8)
    monkeypatch.setitem(image_folders.LONGEST, "cpu", 12)
    command = (*short, "data=inward", "data.root=scene", "data.downscale=auto")
    outcome = devrf(*command, "stage=canonical", "hydra.run.dir=run")
    assert outcome.status == 0 and "12x10 px, made smaller by 2 (chosen for a CPU" in outcome.out
    # Moved to a machine that would take whole images.
    monkeypatch.setitem(image_folders.LONGEST, "cpu", 1600)
    assert "learned already" in devrf(*command, "stage=canonical", "hydra.run.dir=run").out
    assert devrf("stage=evaluate", "hydra.run.dir=run").status == 0
    settings = json.loads((tmp_path / "run" / "metrics.json").read_text())["run"]["settings"]
    assert settings["data.downscale"] == 2


def test_the_needs_are_told_first(trained) -> None:
    lines = trained[1].out.splitlines()
    said = [k for k, line in enumerate(lines) if NEEDS.search(line)]
    assert len(said) == 1
    assert said[0] < next(k for k, line in enumerate(lines) if "fields live in" in line)


@pytest.mark.parametrize(
    ("argument", "key", "change"),
    [
        ("schedule.canonical.side=9000", "schedule.canonical.side", r"side=\d{3,4}"),
        (
            "schedule.deformation.levels.2={side:9000,iterations:1}",
            "schedule.deformation.levels.2.side",
            r"levels.2.side=\d{3,4}",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_a_change_that_fits(
    devrf, tiny, tmp_path, argument, key, change
) -> None:
    outcome = devrf(*tiny, argument, "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {key}: the run needs about ")
    assert re.search(rf"lack of host memory; give \S*{change} \([\d.]+ of", outcome.err)
    assert not (tmp_path / "run").exists()


def test_a_budget_of_seconds_makes_do_with_the_batches_that_fit(
    devrf, tiny_data, short, monkeypatch
) -> None:
    method = ("method=dnerf", "profile=dnerf_small", "protocol=joint", "stage=joint")
    command = (*tiny_data, *method, "ray_stage.schedule.rays=64000", "trainer=cpu")
    monkeypatch.setattr(fitting, "free_host_memory", lambda: 2 * 10**9 - fitting.own_memory())
    outcome = devrf(*command)
    assert outcome.status == 2 and "lack of host memory" in outcome.err
    outcome = devrf(*command, "schedule.seconds=600", "+trainer.fast_dev_run=true")
    assert outcome.status == 0
    assert "batches have at most 0.016 of their rays" in outcome.out


def test_a_full_disk_is_noticed_before_it_begins(devrf, tiny, monkeypatch) -> None:
    monkeypatch.setattr(fitting, "free_disk", lambda folder: 1000)
    outcome = devrf(*tiny)
    assert outcome.status == 2
    assert " of 9.3e-07 GiB of disk; it would end for lack of disk" in outcome.err


def test_little_memory_refuses_what_is_not_finished_and_changes_nothing(
    devrf, tiny, monkeypatch, tmp_path
) -> None:
    command = (*tiny, "stage=canonical", "hydra.run.dir=run")
    monkeypatch.setattr(fitting, "free_host_memory", lambda: -(10**12))
    assert devrf(*command, "memory_check=false").status == 0
    # What is learned already needs nothing.
    assert devrf(*command).status == 0
    outcome = devrf(*command, "resume=false")
    assert outcome.status == 2 and "lack of host memory" in outcome.err
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert not (tmp_path / "run" / "previous-1").exists()


def test_running_out_of_memory_is_one_line(devrf, tiny, monkeypatch) -> None:
    def enter(stage: object, phase: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB.")

    monkeypatch.setattr("devrf.methods.devrf.canonical_stage.CanonicalStage.enter", enter)
    outcome = devrf(*tiny)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: stage=canonical: out of memory (3.0 GiB more asked, ")
    assert "lower schedule.canonical.rays" in outcome.err


def test_networks_too_wide_to_build_are_one_line(devrf, tiny_data) -> None:
    outcome = devrf(*tiny_data, "method=dnerf", "ray_stage.model.settings.width=400000")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "out of memory" in outcome.err


# Neither a batch nor half of one fits into the memory left to the program.
LARGE = (
    "schedule.canonical.rays=200000",
    "schedule.canonical.epochs=null",
    "schedule.canonical.iterations=2",
    "schedule.canonical.upsample_at=[]",
    "stage=canonical",
    "hydra.run.dir=run",
)


@linux
def test_memory_that_is_short_halves_batches_then_ends_the_stage(warm, tiny, tmp_path) -> None:
    outcome = warm(tmp_path, *tiny, *LARGE, most_memory=100 * 2**20)
    assert outcome.status == 2, outcome.out
    *_, halved, ended = outcome.out.splitlines()
    assert halved.startswith("out of memory (") and "half of their rays" in halved
    assert ended.startswith("devrf: canonical stage: out of memory (")
    assert "lower schedule.canonical.side or schedule.canonical.rays, or higher" in ended


@linux
def test_the_estimate_is_near_what_is_taken(warm, tiny, tmp_path) -> None:
    command = (
        *tiny,
        "field.width=128",
        "data.width=96",
        "data.height=96",
        "stage=canonical",
        "schedule.canonical.side=80",
        "schedule.canonical.rays=4096",
        "schedule.canonical.iterations=2",
        "schedule.canonical.upsample_at=[1]",
        "hydra.run.dir=run",
        "callbacks.checkpoint.every_seconds=0",
        "callbacks.checkpoint.share=1.0",
        "trainer.log_every_n_steps=1",
    )
    outcome = warm(tmp_path, *command)
    assert outcome.status == 0, outcome.out
    said = NEEDS.search(outcome.out)
    assert said is not None
    with (tmp_path / "run" / "logs" / "canonical" / "metrics.csv").open(newline="") as file:
        taken = max(float(row["static/peak_host_gb"] or 0) for row in csv.DictReader(file))
    assert 0.6 < float(said.group(1)) / taken < 1.7, (said.group(1), taken)

"""A run says what it needs, refuses what cannot be, and lives with little memory."""

from __future__ import annotations

import csv
import json
import re
import sys

import pytest
import torch

from devrf.apps import forecast
from devrf.apps.forecast import Forecast, needed_bytes
from devrf.engine.needs import SIZE, StageNeeds, tensor_bytes
from devrf.scenes import image_folders
from devrf.scenes.scene import Scene

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux limits and counts it")
NEEDS = re.compile(
    r"needs about ([\d.]+) of [\d.]+ GiB of host memory, ([\d.]+) of [\d.]+ GiB of disk"
)


def test_what_is_needed_by_hand(tiny_scene: Scene) -> None:
    parts = {SIZE: 50, "grid": 100, "schedule.rays": 800}
    stage = StageNeeds(parts, {"grid": 40}).with_batches(0.5)
    assert stage.parts == {**parts, "schedule.rays": 400}
    moving = tiny_scene.dynamic.train
    assert moving.flow is not None
    assert tensor_bytes(moving.flow) == (2 * 4 + 1) * len(moving) * 24 * 18
    captures = tensor_bytes(tiny_scene.captures.values())
    on_gpu = needed_bytes(tiny_scene, [stage], 2, on_gpu=True)
    host = {"grid": 80, SIZE: captures, "": forecast.PROGRAM}
    assert on_gpu == {"GPU memory": stage.parts, "host memory": host, "disk": {"grid": 400}}
    on_host = needed_bytes(tiny_scene, [stage], 2, on_gpu=False)["host memory"]
    assert sum(on_host.values()) == 2 * (forecast.PROGRAM + captures + 1.3 * 550)


def test_a_shortage_names_its_largest_key_and_the_size_that_suffices() -> None:
    """100 bytes of images made smaller by 2, and 64 of a grid."""
    needed = {"host memory": {"": 10.0, "side": 64.0, SIZE: 100.0}, "disk": {"side": 9.0}}

    def of(memory: float, disk: float = 9.0) -> Forecast:
        return Forecast(needed, {"host memory": memory, "disk": disk})

    assert of(174).shortage() is None and of(174, 8).shortage() == "disk"
    assert of(173).shortage() == "host memory"
    assert of(173).key("host memory") == SIZE and of(173, 8).key("disk") == "side"
    # By 3 images take 44.4 bytes, by 16, the most, 1.6.
    assert of(119).downscale(2) == 3 and of(118).downscale(2) == 4
    assert of(76).downscale(2) == 15 and of(75).downscale(2) is None
    assert of(174, 8).downscale(2) is None


def test_the_size_that_was_chosen_stays(devrf, tiny_data, short, tmp_path, monkeypatch) -> None:
    assert devrf(*tiny_data, "stage=prepare", "prepare.into=scene").status == 0
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
    ("argument", "key"),
    [
        ("schedule.canonical.side=9000", "schedule.canonical.side"),
        (
            "schedule.deformation.levels.2={side:9000,iterations:1}",
            "schedule.deformation.levels.2.side",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_the_key_to_lower(
    devrf, tiny, tmp_path, argument, key
) -> None:
    outcome = devrf(*tiny, argument, "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {key}: the run needs about ")
    change = "lower it, or free some host memory, or try all the same with memory_check=false"
    assert outcome.err.endswith(f"it would end for lack of host memory; {change}\n")
    assert not (tmp_path / "run").exists()


def test_a_budget_of_seconds_needs_what_its_largest_batches_do(
    devrf, tiny_data, short, monkeypatch
) -> None:
    method = ("method=dnerf", "profile=dnerf_small", "protocol=joint", "stage=joint")
    command = (*tiny_data, *method, "ray_stage.schedule.rays=64000", "trainer=cpu")
    monkeypatch.setattr(forecast, "free_host_memory", lambda: 2 * 10**9 - forecast.own_memory())
    budget = ("schedule.seconds=600", "+trainer.fast_dev_run=true")
    outcome = devrf(*command, *budget)
    assert outcome.status == 2 and outcome.err.startswith("devrf: ray_stage.schedule.rays: the run")
    assert devrf(*command, *budget, "callbacks.time_budget.largest_batch=0.01").status == 0


def test_a_full_disk_is_noticed_before_it_begins(devrf, tiny, monkeypatch) -> None:
    monkeypatch.setattr(forecast, "free_disk", lambda folder: 1000)
    outcome = devrf(*tiny)
    assert outcome.status == 2
    assert " of 9.3e-07 GiB of disk; it would end for lack of disk" in outcome.err


def test_little_memory_refuses_what_is_not_finished_and_changes_nothing(
    devrf, tiny, monkeypatch, tmp_path
) -> None:
    command = (*tiny, "stage=canonical", "hydra.run.dir=run")
    monkeypatch.setattr(forecast, "free_host_memory", lambda: -(10**12))
    assert devrf(*command, "memory_check=false").status == 0
    # What is learned already needs nothing.
    assert devrf(*command).status == 0
    outcome = devrf(*command, "resume=false")
    assert outcome.status == 2 and "lack of host memory" in outcome.err
    assert (tmp_path / "run" / "checkpoints" / "canonical.ckpt").is_file()
    assert not (tmp_path / "run" / "previous-1").exists()


@pytest.mark.parametrize(
    ("words", "where", "stage", "rays"),
    [
        ((), "devrf.canonical_stage.CanonicalStage", "canonical", "schedule.canonical.rays"),
        (
            ("method=dnerf", "profile=dnerf_small", "protocol=joint"),
            "ray_stage.RayStage",
            "joint",
            "ray_stage.schedule.rays",
        ),
    ],
)
def test_running_out_of_memory_is_one_line(
    devrf, tiny_data, monkeypatch, words, where, stage, rays
) -> None:
    def enter(stage: object, phase: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB.")

    monkeypatch.setattr(f"devrf.methods.{where}.enter", enter)
    outcome = devrf(*tiny_data, "trainer=cpu", *words)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: stage={stage}: out of memory (3.0 GiB more asked, ")
    assert f"lower {rays}; " in outcome.err


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

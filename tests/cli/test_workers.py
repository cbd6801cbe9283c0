"""``trainer=ddp``: two processes on a CPU learn one scene, and end together."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os

import pytest

TWO = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
# A scene and schedules that reach about 18 dB in seconds, with little noise.
MEANINGFUL = (
    "data.width=32",
    "data.height=32",
    "data.static_views=12",
    "data.static_test_views=2",
    "data.train_views=3",
    "data.frames=4",
    "data.supersample=1",
    "field.width=16",
    "schedule.canonical.iterations=60",
    "schedule.canonical.side=24",
    "schedule.canonical.search_side=24",
    "schedule.canonical.upsample_at=[20]",
    "schedule.canonical.rays=512",
    "schedule.deformation.levels.1={side:6,iterations:8}",
    "schedule.deformation.levels.2={side:12,iterations:8,parallel_frames:2}",
    "schedule.deformation.levels.3=null",
    "schedule.deformation.rays=512",
    "video.frames=1",
    "evaluation.metrics=[]",
)
# Callbacks for both processes, in a module that both can import.
MODULE = '''
import hashlib, json, os, signal
from pathlib import Path
import torch
from lightning import Callback
from devrf.errors import DevrfError


class Witness(Callback):
    """Records fields, metrics and seed of a process."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer, stage):
        tensors = {k: v for k, v in stage.state_dict().items() if isinstance(v, torch.Tensor)}
        seen = {k: hashlib.sha256(v.numpy().tobytes()).hexdigest() for k, v in tensors.items()}
        metrics = {k: v.item() for k, v in trainer.callback_metrics.items()}
        path = self.folder / f"{stage.capture}-{trainer.global_rank}.json"
        words = {"fields": seen, "metrics": metrics, "seed": stage.generator.initial_seed()}
        path.write_text(json.dumps(words))


class Trip(Callback):
    """Fails in one process, while the other goes on."""

    def __init__(self, rank: int, how: str) -> None:
        self.rank, self.how = rank, how

    def on_train_start(self, trainer, stage):
        if trainer.global_rank == self.rank:
            if self.how == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "mistake":
                raise DevrfError("data.root: gone")
            raise ZeroDivisionError("ours")


class Stray(Callback):
    """Changes a field in one process."""

    def on_train_end(self, trainer, stage):
        if trainer.global_rank == 1:
            stage.scene_model.canonical.color.values.data[0, 0, 0] += 1
'''


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """A folder with the module ``witnesses``."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "witnesses.py").write_text(MODULE)
    return folder


@pytest.fixture(scope="module")
def pair(python, tmp_path_factory, modules):
    """The folder of a run in two processes, and the command's outcome."""
    folder = tmp_path_factory.mktemp("pair")
    arguments = (
        *MEANINGFUL,
        *TWO,
        "hydra.run.dir=run",
        "+callbacks.witness._target_=witnesses.Witness",
        f"+callbacks.witness.folder={folder}",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(modules), prepend=os.pathsep)
        done = python(folder, "-m", "devrf", *arguments)
    return folder, done


@pytest.fixture
def arguments(tiny, modules, monkeypatch):
    """The canonical stage of the tiny scene, in two processes that can import ``witnesses``."""
    monkeypatch.syspath_prepend(str(modules))
    return *(word for word in tiny if word != "trainer=cpu"), *TWO, "stage=canonical"


def test_it_ends_well_and_one_process_speaks(pair):
    _, done = pair
    assert (done.status, done.err) == (0, "")
    said = done.out.splitlines()
    assert len([line for line in said if line.startswith("canonical: seconds")]) == 1
    assert len(said) == len(set(said))


@pytest.mark.parametrize("capture", ["static", "dynamic"])
def test_both_processes_come_to_the_same_by_rays_of_their_own(pair, capture):
    first, second = (
        json.loads((pair[0] / f"{capture}-{rank}.json").read_text()) for rank in (0, 1)
    )
    assert first["fields"] == second["fields"] and len(first["fields"]) > 3
    # What each process measures of itself is its own.
    own = {f"{capture}/{name}" for name in ("iterations_per_second", "peak_host_gb")}
    one, other = (
        {k: v for k, v in rank["metrics"].items() if k not in own} for rank in (first, second)
    )
    assert one == other and f"{capture}/loss" in one
    assert first["seed"] != second["seed"]


def test_the_result_is_that_of_one_process_with_as_many_rays(pair, devrf, tmp_path):
    outcome = devrf(*MEANINGFUL, "trainer=cpu", "hydra.run.dir=one")
    assert outcome.status == 0
    folders = (tmp_path / "one", pair[0] / "run")
    one, two = (json.loads((folder / "metrics.json").read_text()) for folder in folders)
    for stage in ("canonical", "deformation"):
        assert two[stage]["iterations"] == one[stage]["iterations"]
        assert two[stage]["psnr"] == pytest.approx(one[stage]["psnr"], abs=0.3)
    assert two["deformation"]["psnr"] > two["deformation"]["rest_pose_psnr"] + 1


def test_one_process_records(pair):
    folder = pair[0] / "run"
    with (folder / "logs" / "pipeline" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for capture in ("static", "dynamic"):
        steps = [row["step"] for row in rows if row[f"{capture}/loss"]]
        assert steps and len(steps) == len(set(steps))
    assert not [path for path in folder.rglob("*") if "partial" in path.name]


def trip(rank: int, how: str) -> list[str]:
    """Arguments that make one process fail."""
    words = ("_target_=witnesses.Trip", f"rank={rank}", f"how={how}")
    return [f"+callbacks.trip.{word}" for word in words]


@pytest.mark.parametrize(
    ("rank", "how", "line"),
    [
        (0, "mistake", "data.root: gone"),
        (1, "mistake", "data.root: gone"),
        (1, "killed", "trainer.devices: the process of rank 1 was ended by signal 9; was"),
    ],
)
def test_a_failure_of_one_process_ends_both_with_its_line(devrf, arguments, rank, how, line):
    outcome = devrf(*arguments, *trip(rank, how))
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {line}")
    assert not multiprocessing.active_children()
    assert not {"LOCAL_RANK", "MASTER_PORT"} & set(os.environ)


def test_a_fault_of_another_process_keeps_its_traceback(devrf, arguments):
    with pytest.raises(RuntimeError, match="(?s)witnesses.py.*ZeroDivisionError: ours"):
        devrf(*arguments, *trip(1, "fault"))
    assert not multiprocessing.active_children()


def test_fields_that_stray_are_not_passed_off_as_the_result(devrf, tmp_path, arguments):
    outcome = devrf(*arguments, "hydra.run.dir=run", "+callbacks.stray._target_=witnesses.Stray")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: trainer: the processes have learned different fields (")
    assert "canonical.color.values)" in outcome.err and outcome.err.count("\n") == 1
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_both_processes_go_on_where_they_were_left(devrf, often, tmp_path, arguments):
    command = (*arguments, *often, "hydra.run.dir=run")
    checkpoints = tmp_path / "run" / "checkpoints"
    assert devrf(*command, "trainer.max_steps=4").status == 0
    assert (checkpoints / "canonical-progress-4.ckpt").is_file()
    outcome = devrf(*command)
    assert (outcome.status, outcome.err) == (0, "")
    assert "canonical: goes on at iteration 4" in outcome.out
    assert {path.name for path in checkpoints.glob("*.ckpt")} == {"canonical.ckpt"}

"""``trainer=ddp``: two processes on a CPU learn one scene, and end together."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os

import pytest

TWO = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
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
'''


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """A folder with the module ``witnesses``."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "witnesses.py").write_text(MODULE)
    return folder


@pytest.fixture(scope="module")
def pair(devrf_in, tiny, tmp_path_factory, modules):
    """The folder of a run in two processes, and the command's outcome."""
    folder = tmp_path_factory.mktemp("pair")
    arguments = (
        *(word for word in tiny if word != "trainer=cpu"),
        *TWO,
        "hydra.run.dir=run",
        "evaluation.metrics=[]",
        "+callbacks.witness._target_=witnesses.Witness",
        f"+callbacks.witness.folder={folder}",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(modules))
        done = devrf_in(folder, *arguments)
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


def test_the_result_is_that_of_one_process_with_as_many_rays(pair, trained):
    folders = (trained[0], pair[0] / "run")
    one, two = (json.loads((folder / "metrics.json").read_text()) for folder in folders)
    for stage in ("canonical", "deformation"):
        assert two[stage]["iterations"] == one[stage]["iterations"]
        assert two[stage]["psnr"] == pytest.approx(one[stage]["psnr"], abs=0.5)


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
    ("how", "line"),
    [
        ("mistake", "data.root: gone"),
        ("killed", "trainer.devices: the process of rank 1 ended by SIGKILL; was"),
    ],
)
def test_a_failure_of_one_process_ends_both_with_its_line(devrf, arguments, how, line):
    outcome = devrf(*arguments, *trip(1, how))
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {line}")
    assert not multiprocessing.active_children()
    assert not {"LOCAL_RANK", "MASTER_PORT"} & set(os.environ)


def test_a_fault_of_another_process_keeps_its_traceback(devrf, arguments):
    with pytest.raises(RuntimeError, match="(?s)witnesses.py.*ZeroDivisionError: ours"):
        devrf(*arguments, *trip(1, "fault"))
    assert not multiprocessing.active_children()


def test_both_processes_go_on_where_they_were_left(devrf, often, tmp_path, arguments):
    command = (*arguments, *often, "hydra.run.dir=run")
    checkpoints = tmp_path / "run" / "checkpoints"
    assert devrf(*command, "trainer.max_steps=4").status == 0
    assert (checkpoints / "canonical-progress-4.ckpt").is_file()
    outcome = devrf(*command)
    assert (outcome.status, outcome.err) == (0, "")
    assert "canonical: goes on at iteration 4" in outcome.out
    assert {path.name for path in checkpoints.glob("*.ckpt")} == {"canonical.ckpt"}

"""``trainer=ddp``: two processes on a CPU learn one scene, and end together."""

from __future__ import annotations

import csv
import json
import os
import socket
import sys

import psutil
import pytest
from hydra.core.hydra_config import HydraConfig
from lightning import Trainer
from torch.distributed import run as torchrun

from devrf.cli import processes
from devrf.cli.processes import run_in_each, starts_processes
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError

TWO = ("trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2")
# Callbacks for both processes, in a module that both can import.
MODULE = '''
import hashlib, json, os, signal, time
from pathlib import Path
import torch
from lightning import Callback
from devrf.callbacks import TrainingCurve, periodic_checkpoint
from devrf.errors import DevrfError


class Witness(Callback):
    """Records fields, metrics and seed of a process."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_fit_end(self, trainer, stage):
        tensors = {k: v for k, v in stage.state_dict().items() if isinstance(v, torch.Tensor)}
        seen = {k: hashlib.sha256(v.numpy().tobytes()).hexdigest() for k, v in tensors.items()}
        metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
        path = self.folder / f"{stage.capture}-{trainer.global_rank}.json"
        words = {"fields": seen, "metrics": metrics, "seed": stage.generator.initial_seed()}
        path.write_text(json.dumps(words))


class Curve(TrainingCurve):
    """Draws the picture of each process in a folder of its own."""

    def setup(self, trainer, pl_module, stage):
        super().setup(trainer, pl_module, stage)
        self.folder = self.folder / str(trainer.global_rank)


class Stop(Callback):
    """Interrupts the command in the second step, once."""

    def on_train_start(self, trainer, stage):
        periodic_checkpoint.AGREE_EVERY = 2

    def on_train_batch_end(self, trainer, stage, outputs, batch, batch_idx):
        second = stage.capture == "static" and stage.position.iteration == 2
        if trainer.global_rank == 0 and second:
            os.kill(os.getppid(), signal.SIGINT)
            time.sleep(2)


class Trip(Callback):
    """Fails in the second process as it learns motion, while the first goes on."""

    def on_train_start(self, trainer, stage):
        if trainer.global_rank == 1 and stage.capture == "dynamic":
            raise DevrfError("data.root: gone")
'''
# Stands for the program in processes of which the second ends, and the first goes on.
ENDED = """
import os, signal, sys, time
if os.environ["RANK"] != "1":
    time.sleep(100)
{}
"""
FAILED = "print('devrf: data.root: gone', file=sys.stderr); sys.exit(2)"
KILLED = "os.kill(os.getpid(), signal.SIGKILL)"


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """A folder with the module ``witnesses``."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "witnesses.py").write_text(MODULE)
    return folder


@pytest.fixture(scope="module")
def learning(tiny, often):
    """``learning(folder)``: how several processes learn, and record in the folder what."""

    def words(folder):
        return (
            *(word for word in tiny if word not in ("trainer=cpu", "~callbacks.training_curve")),
            *("trainer=ddp", "trainer.accelerator=cpu", *often),
            "hydra.run.dir=run",
            "evaluation.metrics=[]",
            "video.frames=1",
            "+callbacks.witness._target_=witnesses.Witness",
            f"+callbacks.witness.folder={folder}",
            "callbacks.training_curve._target_=witnesses.Curve",
            f"callbacks.training_curve.folder={folder}/curves",
        )

    return words


def by_torchrun(warm, folder, modules, *arguments):
    """Run the command on two nodes of torchrun, here; how each ended."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    nodes = ("--nnodes=2", "--nproc-per-node=1", "--master-addr=127.0.0.1", f"--master-port={port}")
    return warm.together(
        [folder / "first", folder / "second"],
        *(*arguments, "trainer.devices=1", "trainer.num_nodes=2", f"hydra.run.dir={folder}/run"),
        path=[str(modules)] * 2,
        torchrun=[[*nodes, f"--node-rank={rank}"] for rank in (0, 1)],
    )


@pytest.fixture(scope="module")
def pair(warm, learning, modules, tmp_path_factory):
    """The folder of a run that two processes of a command begin, and how it was interrupted.

    Two nodes of torchrun go on with it; how that went.
    """
    folder = tmp_path_factory.mktemp("pair")
    arguments = learning(folder)
    stop = ("trainer.devices=2", "stage=canonical", "+callbacks.stop._target_=witnesses.Stop")
    interrupted = warm(folder, *arguments, *stop, path=str(modules))
    assert (folder / "run" / "checkpoints" / "canonical-progress-3.ckpt").is_file(), interrupted.out
    return folder, interrupted, by_torchrun(warm, folder, modules, *arguments, stop[-1])


def test_an_interrupted_command_ends_its_processes(pair):
    folder, interrupted, _ = pair
    line = "devrf: interrupted at iteration 3 of 6 of the canonical stage; run the same command"
    assert (interrupted.status, interrupted.out.count(line)) == (130, 2), interrupted.out
    running = [process.info["cmdline"] or [] for process in psutil.process_iter(["cmdline"])]
    assert not [words for words in running if str(folder) in " ".join(words)]


def test_it_goes_on_ends_well_and_one_process_speaks(pair):
    folder, _, (first, second) = pair
    assert (first.status, second.status) == (0, 0), first.err + second.err
    said = first.out.splitlines()
    assert len([line for line in said if line.startswith("canonical: seconds")]) == 1
    assert len(said) == len(set(said))
    assert "canonical: goes on at iteration 3" in first.out + first.err
    # torchrun's agent warns there when the agent that keeps the store ends before it.
    assert second.out == "" and "devrf:" not in first.err + second.err
    left = {path.name for path in (folder / "run" / "checkpoints").glob("*.ckpt")}
    assert left == {"canonical.ckpt", "deformation.ckpt"}


def test_one_process_draws_the_curve_of_a_resumed_stage(pair):
    drawn = {str(path.relative_to(pair[0] / "curves")) for path in pair[0].glob("curves/**/*.png")}
    assert drawn == {"0/training_canonical.png", "0/training_deformation.png"}


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


def test_one_process_records(pair):
    folder = pair[0] / "run"
    with (folder / "logs" / "pipeline" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for capture in ("static", "dynamic"):
        steps = [row["step"] for row in rows if row[f"{capture}/loss"]]
        assert steps and len(steps) == len(set(steps))
    assert not [path for path in folder.rglob("*") if "partial" in path.name]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert [metrics[stage]["iterations"] for stage in ("canonical", "deformation")] == [6, 12]


@pytest.mark.parametrize(
    ("end", "line"),
    [
        (FAILED, "data.root: gone"),
        (KILLED, "trainer.devices: the process of rank 1 ended by SIGKILL; was"),
    ],
    ids=["failed", "killed"],
)
def test_a_process_that_ends_ends_the_command_with_its_line(warm, tiny, tmp_path, end, line):
    (tmp_path / "devrf").mkdir()
    (tmp_path / "devrf" / "__init__.py").touch()
    (tmp_path / "devrf" / "__main__.py").write_text(ENDED.format(end))
    arguments = (*(word for word in tiny if word != "trainer=cpu"), *TWO, "stage=canonical")
    # A folder that is another whenever the command line is composed.
    arguments += ("hydra.run.dir=${now:%f}",)
    outcome = warm(tmp_path, *arguments, path=str(tmp_path))
    assert outcome.status == 2 and "Traceback" not in outcome.out
    (said,) = (said for said in outcome.out.splitlines() if said.startswith("devrf: "))
    assert said.startswith(f"devrf: {line}")


def test_a_sweeps_job_learns_in_processes_of_its_own_until_one_fails(
    pair, warm, learning, modules, tmp_path
):
    trip = ("+callbacks.trip._target_=witnesses.Trip", "trainer.devices=2")
    arguments = (*learning(tmp_path), *trip, "hydra.sweep.dir=sweep")
    outcome = warm(tmp_path, "-m", *arguments, path=str(modules))
    assert outcome.status == 3 and "Traceback" not in outcome.out
    assert (tmp_path / "sweep" / "0_robot" / "checkpoints" / "canonical.ckpt").is_file()
    # What others learn, without a break and without torchrun's nodes.
    fields = [
        json.loads((folder / f"static-{rank}.json").read_text())["fields"]
        for folder in (pair[0], tmp_path)
        for rank in (0, 1)
    ]
    assert fields == fields[:1] * 4
    lines = [said for said in outcome.out.splitlines() if said.startswith("devrf: ")]
    failed, job, _ = (said for said in lines if "interrupted" not in said)
    assert failed == "devrf: data.root: gone"
    assert job.endswith("the process of rank 1 ended with status 2, and says why")


def test_a_sweep_of_rehearsals_in_several_processes_has_no_objective(devrf, tiny, monkeypatch):
    monkeypatch.setattr(torchrun, "run", lambda started: None)
    outcome = devrf("-m", *tiny, *TWO, "rehearse=true", "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err


def test_the_environment_of_the_processes_is_theirs_alone(monkeypatch, tmp_path):
    given: dict[str, str] = {}
    monkeypatch.setattr(torchrun, "run", lambda started: given.update(os.environ))
    monkeypatch.setattr(processes, "in_sweep", lambda: False)
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(sys, "argv", ["devrf"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # as the entry point does
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    trainer = Trainer(accelerator="cpu", devices=2, strategy=ManualDDP(), logger=False)
    before = dict(os.environ)
    run_in_each(trainer.strategy, tmp_path)
    assert (given["HYDRA_FULL_ERROR"], given["OMP_NUM_THREADS"]) == ("0", "1")
    assert dict(os.environ) == before


def test_where_none_can_be_started_a_line_says_so(tmp_path):
    for nodes, line in ((1, "needs the command line"), (2, "several machines need torchrun")):
        trainer = Trainer(
            accelerator="cpu", devices=2, num_nodes=nodes, strategy=ManualDDP(), logger=False
        )
        assert starts_processes(trainer.strategy)
        with pytest.raises(DevrfError, match=line):
            run_in_each(trainer.strategy, tmp_path)


def test_tasks_of_slurm_without_a_common_folder_end_with_a_line_each(warm, tiny, tmp_path):
    # What srun sets in the tasks of two nodes.
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    job = {"SLURM_JOB_ID": "1", "SLURM_JOB_NAME": "devrf", "SLURM_NTASKS": "2"}
    job |= {"SLURM_NNODES": "2", "SLURM_NTASKS_PER_NODE": "1", "SLURM_LOCALID": "0"}
    job |= {"SLURM_NODELIST": "127.0.0.1", "MASTER_PORT": str(port)}
    tasks = [{**job, "SLURM_PROCID": str(k), "SLURM_NODEID": str(k)} for k in (0, 1)]
    command = (*(word for word in tiny if word != "trainer=cpu"), "trainer=ddp")
    command += ("trainer.accelerator=cpu", "trainer.devices=1", "trainer.num_nodes=2")
    folders = [tmp_path / "first", tmp_path / "second"]
    ended = warm.together(folders, *command, "hydra.run.dir=run", environment=tasks)
    for folder, outcome in zip(folders, ended, strict=True):
        assert outcome.status == 2 and outcome.err.count("\n") == 1
        assert outcome.err.startswith(f"devrf: {folder / 'run'}: not there on every node; give")

"""A run that is killed at any moment, and started again, comes to the same numbers."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import load_checkpoint

# A search, two sizes of the field, two of the motion; a progress file after every Lightning step
# of two iterations whose line of the curves is not still to be written.
COMMAND = (
    "data.width=16",
    "data.height=14",
    "data.static_test_views=1",
    "schedule.canonical.search_iterations=6",
    "field.search_alpha_init=0.01",
    "schedule.canonical.iterations=14",
    "schedule.canonical.upsample_at=[5]",
    "schedule.canonical.side=12",
    "schedule.canonical.search_side=12",
    "schedule.deformation.levels.1.iterations=4",
    "schedule.deformation.levels.2.iterations=4",
    "schedule.visit.occupancy_every=3",
    "canonical.iterations_per_step=2",
    "deformation.iterations_per_step=2",
    "callbacks.checkpoint.every_seconds=0",
    "callbacks.checkpoint.share=1.0",
    "trainer.log_every_n_steps=3",
    "evaluation.metrics=[]",
    "video.frames=1",
    "video.height=40",
    "hydra.run.dir=run",
)
# These differ from run to run; "run" in metrics.json holds the process and its command.
TIMES = {"seconds", "iterations_per_second", "peak_host_gb", "checkpoint_mb", "run"}


@pytest.fixture(scope="module")
def command(tiny) -> tuple[str, ...]:
    """The command whose run is to survive."""
    return (*tiny, *COMMAND)


@pytest.fixture(scope="module")
def whole(warm, command, tmp_path_factory) -> Path:
    """The folder of the command that is not interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    outcome = warm(folder, *command)
    assert outcome.status == 0, outcome.out
    return folder


def untimed(values: Any) -> Any:
    """The values without those that tell of clocks and memory."""
    if not isinstance(values, dict):
        return values
    kept = {key: value for key, value in values.items() if key.rpartition("/")[2] not in TIMES}
    return {key: untimed(value) for key, value in kept.items()}


def curves(folder: Path) -> list[dict[str, str]]:
    """The rows of the run's curves."""
    with (folder / "run" / "logs" / "pipeline" / "metrics.csv").open(newline="") as file:
        return [untimed(row) for row in csv.DictReader(file)]


def assert_same(folder: Path, whole: Path) -> None:
    """Compare scores and fields to the last bit; nothing else may be left."""
    ours, theirs = (
        untimed(json.loads((one / "run" / "metrics.json").read_text())) for one in (folder, whole)
    )
    assert ours == theirs
    for name in ("canonical", "deformation"):
        path = Path("run") / "checkpoints" / f"{name}.ckpt"
        ours, theirs = (load_checkpoint(one / path).model.state_dict() for one in (folder, whole))
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert not list((folder / "run").rglob("*partial*"))
    assert not list((folder / "run" / "checkpoints").glob("*progress*"))


# In the canonical stage, while files are written, and in the deformation stage: 20 and 24 steps.
KILLS = ((("step", 13), 0.01), (("file", 20), 0.0), (("step", 9), 0.005))


def test_a_run_that_is_killed_again_and_again_comes_to_the_same_numbers(
    warm, command, whole, tmp_path
):
    for when, delay in KILLS:
        killed = warm(tmp_path, *command, after=when, delay=delay, signals=(signal.SIGKILL,))
        assert killed.status == -signal.SIGKILL
    outcome = warm(tmp_path, *command)
    assert outcome.status == 0, outcome.out
    assert_same(tmp_path, whole)
    assert curves(tmp_path) == curves(whole)


def test_a_signal_ends_a_run_saved_and_it_goes_on(warm, command, whole, tmp_path):
    number, step, where = signal.SIGUSR1, 30, "iteration 10 of 24 of the deformation stage"
    # Nothing is written now and then: what it goes on from was written at the signal.
    rarely = (*command, "callbacks.checkpoint.every_seconds=1000")
    # Launchers may say it twice.
    outcome = warm(tmp_path, *rarely, after=("step", step), signals=(number, signal.SIGTERM))
    assert outcome.status == 128 + number
    last = outcome.out.splitlines()[-1]
    assert last == f"devrf: interrupted at {where}; run the same command again to go on"
    outcome = warm(tmp_path, *rarely)
    assert outcome.status == 0, outcome.out
    assert f"goes on at {where.partition(' of')[0]}\n" in outcome.out
    assert_same(tmp_path, whole)
    # A run that is asked to end writes its last step's line, whether it was due or not.
    extra = [row for row in curves(tmp_path) if row not in curves(whole)]
    assert len(extra) <= 1
    assert [row for row in curves(tmp_path) if row not in extra] == curves(whole)


def test_a_second_ctrl_c_ends_a_run_at_once(warm, command, tmp_path):
    outcome = warm(tmp_path, *command, after=("step", 9), signals=(signal.SIGTERM, signal.SIGINT))
    assert outcome.status == 130
    assert outcome.out.splitlines()[-1] == (
        "devrf: ended at once; run the same command again to go on"
    )
    left = {path.name for path in (tmp_path / "run" / "checkpoints").iterdir()}
    assert left == {"canonical-progress-6.ckpt", "canonical-progress-8.ckpt"}


def test_a_signal_ends_a_sweep(warm, command, tmp_path):
    sweep = ("seed=0,1", "stage=canonical", "hydra.sweep.dir=sweep")
    outcome = warm(
        tmp_path, "--multirun", *command, *sweep, after=("step", 3), signals=(signal.SIGINT,)
    )
    assert outcome.status == 130
    assert len(list((tmp_path / "sweep").glob("*/checkpoints"))) == 1


def test_a_full_disk_is_said_and_the_run_goes_on_when_there_is_room(warm, command, whole, tmp_path):
    command = tuple(word for word in command if word != "~callbacks.training_curve")
    # Left after iteration 6; from then on no file may be as large as a checkpoint.
    assert warm(tmp_path, *command, after=("step", 6), signals=(signal.SIGTERM,)).status == 143
    good = tmp_path / "run" / "checkpoints" / "canonical-progress-6.ckpt"
    before = good.read_bytes()
    finished = (whole / "run" / "checkpoints" / "canonical.ckpt").stat().st_size
    outcome = warm(tmp_path, *command, most_bytes=min(len(before), finished) // 2)
    assert outcome.status == 2
    told = [line for line in outcome.out.splitlines() if "File too large" in line]
    warned, drawn, last = told[-3:]
    assert "training goes on, the last good progress file stays (iteration 6)" in warned
    assert "training_canonical.png" in drawn and drawn.endswith("the curve is not drawn")
    assert outcome.out.count("training goes on") == 1
    assert last.startswith("devrf: ") and "canonical.ckpt: File too large" in last
    assert good.read_bytes() == before

"""What ends a stage before its schedule is said, and never passed off as the result."""

from __future__ import annotations

import shutil

import pytest
import torch

from devrf.checkpoints.checkpoint import load_checkpoint

# Of Lightning's trainer; each ends the canonical stage after so many of its six iterations.
LIMITS = [
    ("trainer.max_steps=2", 2),
    ("+trainer.limit_train_batches=2", 2),
    ("+trainer.max_time=00:00:00:00", 0),
    ("trainer.max_epochs=0", 0),
]


def fields(folder, stage="canonical"):
    return load_checkpoint(folder / "checkpoints" / f"{stage}.ckpt").model.state_dict()


@pytest.fixture(scope="module")
def command(tiny, often):
    """A pipeline of a Lightning step an iteration, that scores and renders next to nothing."""
    return (*tiny, *often, "evaluation.metrics=[]", "video.frames=1", "hydra.run.dir=run")


@pytest.fixture(scope="module")
def whole(devrf_in, command, tmp_path_factory):
    """The folder of the canonical stage that nothing ends early."""
    folder = tmp_path_factory.mktemp("whole")
    assert devrf_in(folder, *command, "stage=canonical").status == 0
    return folder / "run"


@pytest.mark.filterwarnings("ignore:The number of training batches")
@pytest.mark.parametrize(("limit", "done"), LIMITS)
def test_a_stage_that_is_cut_short_ends_the_pipeline_and_goes_on_without_the_limit(
    devrf, command, whole, tmp_path, limit, done
):
    # A file is written at the end alone.
    rarely = (*command, "callbacks.checkpoint.every_seconds=1000")
    outcome = devrf(*rarely, limit)
    where = f"{limit.strip('+')}: learning has ended at iteration {done} of 6 of the canonical"
    assert outcome.status == 2 and outcome.err.startswith(f"devrf: {where} stage; the same ")
    assert outcome.err.count("\n") == 1
    left = [path.name for path in tmp_path.rglob("*.ckpt")]
    assert left == ([f"canonical-progress-{done}.ckpt"] if done else [])
    outcome = devrf(*rarely, "stage=canonical")
    assert (outcome.status, outcome.err) == (0, "")
    assert (f"canonical: goes on at iteration {done}\n" in outcome.out) == bool(done)
    assert "iterations 6," in outcome.out
    torch.testing.assert_close(fields(tmp_path / "run"), fields(whole), rtol=0, atol=0)


@pytest.mark.parametrize("key", ["limit_train_batches", "overfit_batches", "val_check_interval"])
def test_a_share_of_a_loader_that_never_ends_is_refused_in_one_line(devrf, command, key):
    outcome = devrf(*command, "stage=canonical", f"+trainer.{key}=0.5")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: trainer: When using an ") and "int" in outcome.err


def test_a_limit_of_time_may_be_a_mapping(devrf, command):
    outcome = devrf(*command, "stage=canonical", "+trainer.max_time={minutes:30}")
    assert (outcome.status, outcome.err) == (0, "")


def test_a_callback_that_ends_a_stage_early_ends_the_pipeline(devrf, command, tmp_path):
    timer = "+callbacks.timer._target_=lightning.pytorch.callbacks.Timer"
    outcome = devrf(*command, timer, "+callbacks.timer.duration=00:00:00:00")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: callbacks: learning has ended at iteration 0 of 6 of the")
    assert not list(tmp_path.rglob("*.ckpt"))


def test_a_trial_goes_through_a_step_of_each_stage_and_leaves_no_result(devrf, command, tmp_path):
    outcome = devrf(*command, "+trainer.fast_dev_run=true")
    assert (outcome.status, outcome.err) == (0, "")
    assert "canonical: a trial, 1 of 6 iterations; nothing is kept" in outcome.out
    assert "deformation: a trial, 1 of 12 iterations; nothing is kept" in outcome.out
    assert {path.name for path in (tmp_path / "run").iterdir()} == {".devrf", ".hydra", "run.log"}
    outcome = devrf(*command, "stage=canonical")
    assert outcome.status == 0 and "goes on at" not in outcome.out
    assert "iterations 6," in outcome.out


@pytest.mark.parametrize("more", [("resume=false",), ("stage=deformation", "logger=csv")])
def test_a_trial_in_a_run_that_is_there_leaves_it_as_it_is(devrf, tiny, trained, tmp_path, more):
    folder = tmp_path / "run"
    shutil.copytree(trained[0], folder)

    def contents():
        files = (path for path in folder.rglob("*") if path.is_file() and path.name != "run.log")
        return {path: path.read_bytes() for path in files if path.parent.name[0] != "."}

    before = contents()
    # The plots too, which a run of this size draws.
    plain = [word for word in tiny if word != "~callbacks.training_curve"]
    again = (*plain, f"hydra.run.dir={folder}", "+trainer.fast_dev_run=2", *more)
    outcome = devrf(*again, "callbacks.checkpoint.every_seconds=0")
    assert (outcome.status, outcome.err) == (0, "")
    assert "deformation: a trial, 2 of 12 iterations; nothing is kept" in outcome.out
    assert contents() == before

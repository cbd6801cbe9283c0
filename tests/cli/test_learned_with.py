"""A later command takes from the checkpoints what they were learned with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.cli.learned_with import completed
from devrf.cli.overrides import recorded


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the checkpoints of a whole tiny run, in a run's folder."""
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    return tmp_path / "run"


def config(folder: Path):
    return OmegaConf.load(folder / ".hydra" / "config.yaml")


@pytest.mark.parametrize("stage", ["evaluate", "inspect", "deformation"])
def test_in_a_folder_nothing_has_to_be_typed_again(devrf, tiny, run, stage):
    outcome = devrf(f"stage={stage}", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    assert f"run: as it was learned, with {tiny[0]}" in outcome.out
    assert ("deformation: learned already" in outcome.out) == (stage == "deformation")
    found = config(run)
    assert (found.data.width, found.schedule.canonical.iterations, found.stage) == (24, 6, stage)


def test_what_is_typed_differs(devrf, run):
    assert devrf("stage=still", "hydra.run.dir=run", "video.frames=2").status == 0
    found = config(run)
    assert (found.video.frames, found.data.frames) == (2, 3)
    # It was for that command; the run is as it was.
    assert devrf("stage=still", "hydra.run.dir=run").status == 0
    assert config(run).video.frames == 4
    outcome = devrf("hydra.run.dir=run", "loss.fine.color=2")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: loss.fine.color: ")


def test_a_run_that_was_interrupted_goes_on_by_its_folder(devrf, tiny, often, tmp_path):
    command = (*tiny, *often, "hydra.run.dir=run", "stage=canonical")
    assert devrf(*command, "trainer.max_steps=4").status == 0
    (tmp_path / "run" / "checkpoints" / "canonical.ckpt").unlink()
    outcome = devrf("hydra.run.dir=run", "stage=canonical")
    assert (outcome.status, outcome.err) == (0, "")
    assert "canonical: goes on at iteration 4" in outcome.out


def test_the_default_folder_is_looked_into_too(devrf, run, tmp_path):
    run.rename(tmp_path / "moved")
    (tmp_path / "outputs" / "robot").mkdir(parents=True)
    (tmp_path / "moved").rename(tmp_path / "outputs" / "robot" / "quickstart")
    # With or without its experiment it is one run.
    for typed in ((), ("experiment=quickstart",)):
        outcome = devrf("stage=still", *typed)
        assert (outcome.status, outcome.err) == (0, "")
    assert [path.name for path in (tmp_path / "outputs" / "robot").iterdir()] == ["quickstart"]


def test_what_is_made_of_a_checkpoint_goes_to_its_run(devrf, run, tmp_path):
    last, first = (run / "checkpoints" / f"{stage}.ckpt" for stage in ("deformation", "canonical"))
    assert devrf("stage=evaluate", f"ckpt={last}").status == 0
    assert "deformation" in json.loads((run / "metrics.json").read_text())
    # An earlier stage does not replace the scores of the whole.
    assert devrf("stage=evaluate", f"ckpt={first}").status == 0
    assert "deformation" in json.loads((run / "metrics.json").read_text())
    assert "deformation" not in json.loads((run / "canonical" / "metrics.json").read_text())
    alone = shutil.copy(last, tmp_path / "my copy.ckpt")
    assert devrf("stage=still", f"ckpt='{alone}'").status == 0
    assert list((tmp_path / "outputs" / "robot" / "my copy" / "images").iterdir())


def test_a_checkpoint_that_does_not_say_how_it_was_learned(devrf, run, tiny):
    path = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(path)
    content["devrf"]["command"] = None
    write_checkpoint_file(path, content)
    outcome = devrf(*tiny, "stage=still", "hydra.run.dir=run")
    assert outcome.status == 0
    assert "run/checkpoints/deformation.ckpt: does not say how it was learned" in outcome.out


def test_a_folder_in_which_nothing_was_learned(devrf, tmp_path):
    outcome = devrf("stage=evaluate", "hydra.run.dir=empty")
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and "empty/checkpoints/" in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_sweep_over_stills_of_a_checkpoint(devrf, run, tmp_path):
    path = run / "checkpoints" / "deformation.ckpt"
    typed = ("stage=still", f"ckpt={path}", "still.time=0,1", "hydra.sweep.dir=stills")
    outcome = devrf("-m", *typed)
    assert (outcome.status, outcome.err) == (0, "")
    made = {path.name for path in tmp_path.glob("stills/*/images/*.png")}
    assert {"still_held_out_t0.png", "still_held_out_t1.png"} <= made


def test_the_jobs_of_a_sweep_are_gone_on_with(devrf, tiny, tmp_path):
    there = "hydra.sweep.dir=sweep"
    assert devrf("-m", *tiny, there, "stage=canonical", "seed=0,1").status == 0
    outcome = devrf("stage=still", there)
    assert (outcome.status, outcome.err) == (0, "")
    assert [config(tmp_path / "sweep" / f"{k}_robot").seed for k in (0, 1)] == [0, 1]
    assert len(list(tmp_path.glob("sweep/*/images"))) == 2
    # One of its jobs is a run like any other.
    assert devrf("stage=still", "hydra.run.dir=sweep/1_robot").status == 0
    assert config(tmp_path / "sweep" / "1_robot").seed == 1


def test_a_job_of_an_experiment_that_sweeps_does_not_start_its_sweep(devrf, run):
    path = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(path)
    content["devrf"]["command"].insert(0, "experiment=ablation_table")
    write_checkpoint_file(path, content)
    assert devrf("stage=still", "hydra.run.dir=run").status == 0
    assert (run / "images").is_dir()


def test_a_command_is_recorded_without_what_is_of_that_command_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    typed = [
        "stage=render",
        "trainer=cpu",
        "data.root='a b'",
        "+x=1",
        "~y",
        "still.time=1",
        "ckpt=c",
        "seed=2",
    ]
    root = f'data.root="{tmp_path}/a b"'
    assert recorded([*typed, "hydra/launcher=joblib"]) == [root, "+x=1", "~y", "seed=2"]


def test_a_checkpoint_does_not_choose_which_code_is_run(devrf, run):
    path = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(path)
    hostile = ["data._target_=os.getcwd", "+hydra.callbacks.x={_target_:os.getcwd}", "seed=1"]
    content["devrf"]["command"] = hostile
    write_checkpoint_file(path, content)
    typed = [f"hydra.run.dir={run}", "stage=still"]
    assert completed(typed) == ["seed=1", "hydra.mode=RUN", *typed]
    content["devrf"]["command"] = ["not an override"]
    write_checkpoint_file(path, content)
    assert completed(typed) == typed


def test_checkpoints_of_a_sweep_share_what_they_have_in_common(run):
    path = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(path)
    content["devrf"]["command"] = ["data.frames=5", "seed=4"]
    write_checkpoint_file(other := path.with_name("other.ckpt"), content)
    content["devrf"]["command"] = ["data.frames=5", "seed=5"]
    write_checkpoint_file(path, content)
    typed = ["-m", "stage=still", f"ckpt={path},{other}"]
    shared = ["data.frames=5", "hydra.sweeper.params=null"]
    assert completed(typed) == ["-m", *shared, *typed[1:]]


def test_another_option_of_a_group_begins_from_its_own_values(run):
    path = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(path)
    content["devrf"]["command"] = ["data=inward", "data.downscale=2", "seed=1", "field.width=8"]
    write_checkpoint_file(path, content)
    there = [f"hydra.run.dir={run}", "stage=inspect"]
    kept = ["seed=1", "field.width=8", "hydra.mode=RUN"]
    assert completed([*there, "data=forward"]) == [*kept, *there, "data=forward"]
    assert completed([*there, "data=inward"])[:2] == ["data.downscale=2", "seed=1"]
    # Another method has other settings.
    kept = ["data=inward", "data.downscale=2", "seed=1", "hydra.mode=RUN"]
    assert completed([*there, "method=dnerf"]) == [*kept, *there, "method=dnerf"]
    assert completed(["--help"]) == ["--help"] and completed([*there, "x=["]) == [*there, "x=["]

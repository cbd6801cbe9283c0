"""A wrong command ends with one line that names the error; nothing is left behind."""

from __future__ import annotations

import re
import shutil
import signal
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from lightning_utilities.core.imports import RequirementCache
from omegaconf import OmegaConf

import devrf as package
from devrf.cli.config import STEPS, known_stages
from devrf.cli.config_check import check_config
from devrf.cli.run import STEPS as TAKEN
from devrf.errors import DevrfError

# Arguments, and what the one line must name.
MISTAKES = {
    "misspelt key": (["data.widht=3"], "data.widht: no such key; did you mean data.width?"),
    "misspelt settings for a scene": (
        ["for_scene=paper_lgo"],
        "did you mean for_scene=paper_lego?",
    ),
    "option with dashes": (["--seed=1"], "--seed=1: no such option; write seed=1, or --help"),
    "template's group": (["debug=default"], "debug=default: no such group; rehearse=true takes"),
    "no folder of runs": (
        ["stage=report", "report.runs=null"],
        "report.runs: expected a valid string",
    ),
    "misspelt logger among several": (["logger=[csv,wand]"], "did you mean logger=wandb?"),
    "key of a logger": (
        ["logger.offline=true"],
        "logger.offline: no such key; it is logger.wandb",
    ),
    "no argument of wandb": (
        ["logger=wandb", "+logger.wandb.nots=mine"],
        "logger.wandb.nots: wandb.init takes no such argument; did you mean logger.wandb.notes?",
    ),
    "no choice of a group": (["method=null"], "method=null: choose one of devrf, dnerf, "),
    "an option that is no name": (["data=false"], "data=false: choose one of colmap, "),
    "several values outside a sweep": (["seed=1,2"], "for argument 'seed=1,2' 1. To use it as "),
    "two things at once": (["-m", "--cfg", "job"], "Only one of --run, --multirun, --cfg, "),
    "a pickled job": (["--experimental-rerun", "no.pickle"], "a pickle may run code; write hydra."),
    "what the run gives the trainer": (
        ["+trainer.default_root_dir=here"],
        "trainer.default_root_dir: a run sets it itself; hydra.run.dir=FOLDER is its folder; ",
    ),
    "key of other scenes": (
        ["data=inward", "data.root=scene", "data.scene_seed=3"],
        "data.scene_seed: no such key; it belongs to data=procedural, procedural_forward",
    ),
    "folder of a scene that is rendered": (
        ["data.root=${oc.env:HOME}"],
        "data.root: no such key; it belongs to data=colmap, dycheck, easyvolcap, forward, inward, ",
    ),
    "appended unknown root key": (["+sede=3"], "sede: no such key; did you mean seed?"),
    "forward-facing field of an inward-facing scene": (
        ["field.planes=48", "stage=canonical"],
        "field.planes=48: planes are of forward-facing scenes, and this scene is not",
    ),
    "missing root": (["data=inward"], "data.root: required; give data.root=PATH"),
    "protocol of another method": (
        ["protocol=joint"],
        "protocol: method=devrf does not learn by protocol=joint",
    ),
    "steps of no length": (["sampling.step=0"], "sampling.step: expected at least 0.01, not 0"),
    "a level without a side": (
        ["schedule.deformation.levels.4={iterations:2}", "schedule.deformation.levels.3=null"],
        "schedule.deformation.levels: expected rows 1 to 3 with side and iterations",
    ),
    "a word in place of a share": (
        ["protocol.stages.canonical.iterations=true"],
        "protocol.stages.canonical.iterations: expected a share above 0, at most 1, not True",
    ),
    "unknown loss term": (["+loss.deformation.foo=1"], "unknown term 'foo'"),
    "unknown accelerator": (["trainer.accelerator=abacus"], "trainer: "),
    "several devices, each for itself": (
        ["trainer.devices=2"],
        "trainer.devices: 2 processes need trainer=ddp",
    ),
    "a strategy that wraps what is learned": (
        ["+trainer.strategy=ddp"],
        "trainer.strategy: expected none, or trainer=ddp",
    ),
    "gradients of several batches": (
        ["+trainer.accumulate_grad_batches=2"],
        "trainer.accumulate_grad_batches: stages take optimiser steps of their own",
    ),
    "clipped gradients": (
        ["+trainer.gradient_clip_val=1.0"],
        "trainer.gradient_clip_val: stages take optimiser steps of their own",
    ),
    "scoring before training": (["stage=evaluate"], "canonical.ckpt: no such checkpoint"),
    "missing checkpoint": (["stage=render", "ckpt=no.ckpt"], "no.ckpt: no such checkpoint"),
    "checkpoint where none is used": (["ckpt=no.ckpt"], "ckpt: stage=pipeline starts from nothing"),
    "a section that is left out": (
        ["~evaluation"],
        "~evaluation: evaluation cannot be left out; change values below it, or its own",
    ),
    "a section to which others refer": (["~schedule"], "~schedule: schedule cannot be left out"),
    "an empty folder's name, which would be the present one": (
        ["hydra.run.dir="],
        "hydra.run.dir=: names nothing; give a path, or leave it out",
    ),
    "an empty name in quotes": (["ckpt=''"], "ckpt='': names nothing; give a path"),
    "no folder to prepare": (
        ["stage=prepare"],
        "prepare.into: stage=prepare needs a folder; give prepare.into=PATH",
    ),
    "an objective that nothing scores, inspected": (
        ["stage=inspect", "objective=dynamic.psnrr"],
        "objective: ",
    ),
    "a program without pictures, inspected": (
        ["stage=inspect", "evaluation.program=other"],
        "evaluation.program: it names the program of evaluation.predictions, which are not given",
    ),
}


# What the check of the composed config refuses, as it does steps of no length.
VALUES = {
    "seed out of range": (["seed=-1"], "seed: expected at least 0, not -1"),
    "samples of which none counts": (
        ["sampling.alpha_threshold=1"],
        "sampling.alpha_threshold: expected below 1, not 1",
    ),
    "a word in place of a number of rays": (
        ["sampling.rays_per_pixel=true"],
        "sampling.rays_per_pixel: expected 1, 2 or 4, not 'True'",
    ),
    "an opacity that is none": (
        ["sampling.search_alpha_threshold=nan"],
        "sampling.search_alpha_threshold: expected below 1, not nan",
    ),
    "a level of a grid of one point": (
        ["schedule.deformation.levels.2.side=1"],
        "schedule.deformation.levels.2.side: expected at least 2, not 1",
    ),
    "no times to export": (["export.times=[]"], "export.times: expected at least 1 item, not 0"),
    "unknown key of a level": (
        ["+schedule.deformation.levels.3.sides=4"],
        "schedule.deformation.levels.3.sides: no such key; did you mean",
    ),
    "a value in place of a part": (
        ["schedule.extensions.bending=1"],
        "schedule.extensions.bending: expected a section with _target_, not 1",
    ),
    "a value in place of a callback": (
        ["callbacks.previews=true"],
        "callbacks.previews: expected a section with _target_, or null, not True",
    ),
    "no previews": (
        ["callbacks.previews.times=0"],
        "callbacks.previews.times: expected at least 1",
    ),
    "seconds that are none": (
        ["schedule.seconds=-3"],
        "schedule.seconds: expected more than 0, not -3",
    ),
    "a word in place of a text or a part": (
        ["trainer.accelerator=true"],
        "trainer.accelerator: expected a valid string, not True",
    ),
    "a value over a reference": (["trainer.deterministic=3"], "trainer.deterministic: expected a "),
    "part that is not there": (["data._target_=devrf.nothing"], "data._target_: cannot load"),
}


@pytest.mark.parametrize("name", VALUES)
def test_a_value_that_does_not_fit_is_named(composed, tiny, name):
    (argument,), expected = VALUES[name]
    config = composed(*tiny)
    override = OverridesParser.create().parse_override(argument)
    OmegaConf.set_struct(config, False)
    OmegaConf.update(config, override.key_or_group, override.value())
    with pytest.raises(DevrfError, match=f"^{re.escape(expected)}"):
        check_config(config)


@pytest.mark.parametrize("name", MISTAKES)
def test_one_line_and_nothing_left(devrf, tmp_path, tiny, short, name):
    arguments, expected = MISTAKES[name]
    inward = "data=inward" in arguments
    outcome = devrf(*(short if inward else tiny), *arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: ")
    assert expected in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_of_another_scene(devrf, tmp_path, tiny, trained):
    checkpoint = trained[0] / "checkpoints" / "canonical.ckpt"
    outcome = devrf(*tiny, "stage=deformation", "data.frames=4", f"ckpt={checkpoint}")
    assert outcome.status == 2
    assert outcome.err.startswith(f"devrf: {checkpoint}: belongs to another scene")
    assert outcome.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_deformation_on_top_of_a_deformation(devrf, tmp_path, tiny, trained):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    outcome = devrf(*tiny, "stage=deformation", f"ckpt={checkpoint}")
    assert outcome.status == 2
    assert "needs a checkpoint of the canonical stage, not of the deformation" in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_file_where_the_run_folder_should_be(devrf, tmp_path, tiny):
    (tmp_path / "taken").write_text("mine")
    outcome = devrf(*tiny, "hydra.run.dir=taken/run")
    said = "cannot be written (Not a directory); use hydra.run.dir=FOLDER"
    assert (outcome.status, outcome.err) == (2, f"devrf: {Path('taken/run')}: {said}\n")


@pytest.mark.parametrize(
    ("stage", "key", "folder"),
    [("canonical", "hydra.run.dir", "y" * 300), ("prepare", "prepare.into", "x" * 300)],
)
def test_a_folder_that_cannot_be_made(devrf, tiny, stage, key, folder):
    outcome = devrf(*tiny, f"stage={stage}", f"{key}={folder}")
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: ") and folder in outcome.err


def test_results_of_an_earlier_run_survive_a_mistake(devrf, tmp_path, tiny, trained):
    checkpoint = tmp_path / "run" / "checkpoints" / "canonical.ckpt"
    checkpoint.parent.mkdir(parents=True)
    shutil.copy(trained[0] / "checkpoints" / "canonical.ckpt", checkpoint)
    before = checkpoint.read_bytes()
    anew = ("stage=canonical", "resume=false", "field.planes=48")
    assert devrf(*tiny, "hydra.run.dir=run", *anew).status == 2
    assert checkpoint.read_bytes() == before


def test_help_names_stages_groups_and_examples(devrf):
    outcome = devrf("--help")
    assert outcome.status == 0
    for words in ("data.root=PATH", "experiment: ", "ablation: "):
        assert words in outcome.out
    named = "|".join(re.findall(r"^stage=(\S+)", outcome.out, re.MULTILINE))
    assert set(named.split("|")) == set(known_stages())


def test_as_a_process_of_its_own(python, tmp_path):
    done = python(tmp_path, "-m", "devrf", "data.widht=3")
    expected = "devrf: data.widht: no such key; did you mean data.width?\n"
    assert (done.status, done.err) == (2, expected)
    assert not list(tmp_path.iterdir())


def test_jobs_of_slurm_where_there_is_none(devrf, tmp_path, tiny, monkeypatch):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.setenv("PATH", str(tmp_path))
    outcome = devrf("-m", "hydra/launcher=slurm", *tiny, "seed=0,1", "stage=canonical")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: hydra/launcher: no srun and no sbatch here; ")
    assert not list(tmp_path.iterdir())


# Python writes what is buffered as it ends; empty is as not set.
@pytest.mark.parametrize(("argument", "unbuffered"), [("--help", ""), ("--version", "1")])
def test_output_that_nobody_reads_ends_it_quietly(
    python, tmp_path, monkeypatch, argument, unbuffered
):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    script = (
        "import os, subprocess, sys\n"
        "read, write = os.pipe()\n"
        "os.close(read)\n"
        f"command = [sys.executable, '-m', 'devrf', '{argument}']\n"
        "sys.exit(subprocess.run(command, stdout=write).returncode)\n"
    )
    done = python(tmp_path, "-c", script)
    assert (done.status, done.err) == (128 + signal.SIGPIPE, "")


def test_a_stage_whose_log_nobody_reads_goes_on(warm, tmp_path, tiny_data):
    step = ("stage=prepare", "prepare.into=scene", "hydra.run.dir=run")
    done = warm(tmp_path, *tiny_data, *step, unread=True)
    assert done.out == "" and list((tmp_path / "scene").rglob("*.png"))


def test_names_with_other_letters_where_the_locale_has_but_ascii(
    python, tmp_path, tiny_data, monkeypatch
):
    monkeypatch.setenv("LC_ALL", "C")
    for name in ("PYTHONUTF8", "PYTHONCOERCECLOCALE"):
        monkeypatch.delenv(name, raising=False)
    typed = *tiny_data, "stage=prepare", "prepare.into=szöne", "hydra.run.dir=läufe"
    done = python(tmp_path, "-m", "devrf", *typed)
    assert (done.status, done.err) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == {"läufe", "szöne"}
    assert "szöne" in done.out
    assert "szöne" in (tmp_path / "läufe" / "run.log").read_text("utf-8")


@pytest.mark.skipif(sys.platform != "linux", reason="here all names are UTF-8")
@pytest.mark.parametrize(
    "typed", ["data.root={}", "hydra.run.dir={}", "stage=capture capture.views=[{}.mp4]"]
)
def test_a_name_that_is_not_utf8_ends_it_before_anything_is_written(
    devrf, devrf_in, tmp_path, tiny, typed
):
    latin = "caf\udce9"  # b"caf\xe9" on the disk
    said = "devrf: {}: its name is not UTF-8 text; rename it\n"
    outcome = devrf(*typed.format(latin).split())
    last = typed.format("caf\\xe9").split()[-1]
    assert (outcome.status, outcome.err) == (2, said.format(last))
    (tmp_path / latin).mkdir()
    outcome = devrf_in(tmp_path / latin, *tiny)
    assert (outcome.status, outcome.err) == (2, said.format(f"{tmp_path}/caf\\xe9"))
    assert [path.name for path in tmp_path.rglob("*")] == [latin]


@pytest.mark.parametrize("run", [[], ["hydra.run.dir=run"]])
def test_a_torchvision_for_another_torch_is_one_line(python, tmp_path, monkeypatch, run):
    """As pip leaves it beside a CPU's torch; Lightning imports it wherever it is installed."""
    (tmp_path / "torchvision").mkdir()
    fault = 'raise RuntimeError("operator torchvision::nms does not exist")'
    (tmp_path / "torchvision" / "__init__.py").write_text(fault)
    (tmp_path / "torchvision-0.29.dist-info").mkdir()
    record = "Metadata-Version: 2.1\nName: torchvision\nVersion: 0.29\n"
    (tmp_path / "torchvision-0.29.dist-info" / "METADATA").write_text(record)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    done = python(tmp_path, "-m", "devrf", "stage=inspect", *run)
    assert done.status == 2 and done.err.count("\n") == 1
    assert done.err.startswith("devrf: torchvision cannot be imported (operator torchvision::nms ")
    assert "run pip uninstall torchvision" in done.err
    # A misspelt key is named before torch and Lightning are loaded.
    done = python(tmp_path, "-m", "devrf", "data.widht=3", *run)
    assert done.err == "devrf: data.widht: no such key; did you mean data.width?\n"


@pytest.mark.parametrize(
    ("argument", "package", "extra"),
    [("logger=tensorboard", "tensorboard", "tensorboard"), ("viewer=true", "viser", "viewer")],
)
def test_a_missing_package_is_named_before_anything_is_learned(
    devrf, tmp_path, monkeypatch, argument, package, extra
):
    monkeypatch.setitem(sys.modules, package, None)  # importing it fails
    outcome = devrf(argument)
    said = f'devrf: {package} is not installed; run pip install "devrf[{extra}]"\n'
    assert (outcome.status, outcome.err) == (2, said)
    assert not list(tmp_path.iterdir())


def test_a_part_of_another_package_that_lacks_its_own_is_one_line(devrf, monkeypatch):
    lacking = RequirementCache("no-such-package")
    monkeypatch.setattr("lightning.pytorch.loggers.mlflow._MLFLOW_AVAILABLE", lacking)
    outcome = devrf("+logger.mine._target_=lightning.pytorch.loggers.MLFlowLogger")
    assert outcome.status == 2 and outcome.err.count("\n") == 1 and "no-such-package" in outcome.err


def test_a_fault_of_the_program_keeps_its_traceback(devrf, monkeypatch):
    monkeypatch.setattr("devrf.cli.run.check_config", lambda config: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        devrf("stage=prepare")


@pytest.mark.parametrize(
    ("argument", "meant"),
    [
        ("rendr", "stage=render"),
        ("quickstart", "experiment=quickstart"),
        ("fox", "data.root=fox"),
        ("experiment=quickstrat", "experiment=quickstart"),
        ("experiment=papr", "experiment=paper"),
        ("stage=evalute", "stage=evaluate"),
        ("kernels=trch", "kernels=torch"),
        ("evaluation.metrics=[lpisp]", "lpips"),
    ],
)
def test_the_closest_is_named(devrf, tmp_path, argument, meant):
    if argument == "fox":
        (tmp_path / "fox").mkdir()
    outcome = devrf(argument)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {argument.split('=')[0]}")
    assert outcome.err.endswith(f"did you mean {meant}?\n")


def test_nothing_is_guessed_from_afar(devrf):
    outcome = devrf("kernels=xyzzy")
    assert outcome.status == 2 and "did you mean" not in outcome.err


def test_the_stages_named_are_those_there_are():
    assert set(STEPS) == set(TAKEN)
    assert set(known_stages()) == {
        "pipeline",
        "canonical",
        "deformation",
        "joint",
        "dynamic",
    } | {*TAKEN}


def test_the_version_is_devrfs(devrf):
    outcome = devrf("--version")
    assert (outcome.status, outcome.out) == (0, f"devrf {package.__version__}\n")

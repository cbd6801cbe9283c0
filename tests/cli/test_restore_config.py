"""A run that knows itself: a later command takes over what it was learned with, and no code."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.cli.complete import commands, completed
from devrf.cli.config import config_folder
from devrf.cli.run import STEPS
from devrf.errors import DevrfError
from devrf.system.files import LARGEST_RECORD, refuse_links


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the checkpoints of a whole tiny run, in a run's folder."""
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    return tmp_path / "run"


@pytest.fixture
def edited(run) -> Callable[..., Path]:
    """``edited(change)``: the run's last checkpoint, valid in form, after ``change(content)``."""

    def write(change: Callable[[dict], object], name: str = "deformation.ckpt") -> Path:
        content = read_checkpoint_file(run / "checkpoints" / "deformation.ckpt")
        change(content["devrf"])
        write_checkpoint_file(run / "checkpoints" / name, content)
        return run / "checkpoints" / name

    return write


@pytest.fixture
def learned_by(edited) -> Callable[..., Path]:
    """``learned_by(choices, settings)``: the run, as if a command with these had learned it."""

    def write(choices: dict, settings: dict, name: str = "deformation.ckpt") -> Path:
        command = {f"/{group}": option for group, option in choices.items()} | settings
        return edited(lambda entry: entry.update(command=command), name)

    return write


def config(folder: Path) -> DictConfig:
    return OmegaConf.load(folder / ".hydra" / "config.yaml")


def composed(typed: list[str]) -> DictConfig:
    """What Hydra composes of what was typed, completed."""
    words = [word for word in completed(typed).words if word != "-m"]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("config", words, return_hydra_config=True)


def test_in_a_folder_nothing_has_to_be_typed_again(devrf, tiny, run):
    outcome = devrf("stage=deformation", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    assert "run/checkpoints/deformation.ckpt: as it was learned, with data.width=24 " in outcome.out
    assert "deformation: learned already" in outcome.out
    assert (config(run).data.width, config(run).schedule.canonical.iterations) == (24, 6)


def test_what_is_typed_differs(devrf, run):
    assert (
        devrf("stage=still", "still.height=20", "hydra.run.dir=run", "video.frames=2").status == 0
    )
    assert (config(run).video.frames, config(run).data.frames) == (2, 3)
    outcome = devrf("hydra.run.dir=run", "loss.fine.render=2")
    assert outcome.status == 2 and outcome.err.startswith("devrf: loss.fine.render: ")
    outcome = devrf("hydra.run.dir=run", "data.widht=2")
    assert outcome.status == 2
    assert outcome.err.startswith("devrf: data.widht: no such key; did you mean data.width")


@pytest.mark.parametrize("stage", ["evaluate", "render", "still", "view", "export"])
def test_what_would_have_to_be_learned_is_refused_where_nothing_learns(devrf, run, stage):
    outcome = devrf(f"stage={stage}", "field.width=32", "hydra.run.dir=run")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    was = f"{run}/checkpoints/deformation.ckpt was made with 16, now it is 32"
    assert outcome.err.startswith(f"devrf: field.width: {was}; stage={stage} learns nothing: ")


@pytest.mark.parametrize(
    ("typed", "key"),
    [
        ("sampling.rays_per_pixel=2", "sampling.rays_per_pixel"),
        ("schedule.deformation.rays=32", "schedule.deformation.rays"),
        ("schedule.seconds=60", "schedule.seconds"),
        ("loss.deformation.flow=1", "loss.deformation.flow"),
        ("data.flow=none", "data.flow"),
        ("data.shape=flower", "data.shape"),
        ("data.speed=2", "data.speed"),
        ("priors=none", "priors"),
        ("seed=1", "seed"),
        ("method=dnerf", "method"),
        ("experiment=cpu_small", "sampling.rays_per_pixel"),
    ],
)
def test_it_is_named_by_the_first_setting_that_differs(devrf, run, typed, key):
    outcome = devrf("stage=still", typed, "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.startswith(f"devrf: {key}")
    assert "was made with" in outcome.err


@pytest.mark.parametrize(
    "typed",
    [
        ["field.width=16", "seed=0", "facing=inward"],  # as it was learned
        ["experiment=quickstart"],
        ["priors=all", "data.supersample=1"],
        ["+callbacks.mine=null", "trainer.max_steps=3", "kernels=torch", "logger=null"],
    ],
)
def test_what_is_shown_may_differ(devrf, run, typed):
    small = ("still.height=20", "hydra.run.dir=run")
    outcome = devrf("stage=still", *typed, *small)
    assert (outcome.status, outcome.err) == (0, "")


def test_a_setting_that_was_not_typed_is_that_of_an_earlier_version(devrf, run, edited):
    edited(lambda entry: entry["training_config"].update({"loss.deformation.flow": 7}))
    small = ("still.height=20", "hydra.run.dir=run")
    assert devrf("stage=still", "video.frames=2", *small).status == 0
    assert devrf("stage=still", "loss.deformation.flow=7", *small).status == 0


def test_what_is_made_of_a_checkpoint_goes_to_its_run(devrf, run, tmp_path):
    last, first = (run / "checkpoints" / f"{stage}.ckpt" for stage in ("deformation", "canonical"))
    assert devrf("stage=evaluate", f"ckpt={last}", "evaluation.metrics=[]").status == 0
    assert "deformation" in json.loads((run / "metrics.json").read_text())
    # An earlier stage does not replace the scores of the whole.
    assert devrf("stage=evaluate", f"ckpt={first}", "evaluation.metrics=[]").status == 0
    assert "deformation" in json.loads((run / "metrics.json").read_text())
    assert "deformation" not in json.loads((run / "canonical" / "metrics.json").read_text())
    alone = shutil.copy(last, tmp_path / "my copy.ckpt")
    assert devrf("stage=still", "still.height=20", f"ckpt='{alone}'").status == 0
    assert list((tmp_path / "outputs" / "robot" / "my copy" / "images").iterdir())


def test_on_the_folder_of_a_sweep_a_command_stands_for_one_on_each_learned_run(run, tmp_path):
    folder = f"hydra.sweep.dir={tmp_path}"
    assert commands(["-m", folder]) == [["-m", folder]]
    (tmp_path / "multirun.yaml").touch()
    with pytest.raises(DevrfError, match="a sweep without a learned run; type the sweep again$"):
        commands(["stage=still", folder])
    for name in ("10_robot", "2_robot"):
        shutil.copytree(run, tmp_path / name)
    (tmp_path / "3_robot").mkdir()  # of a job that failed
    runs = [["stage=still", f"hydra.run.dir={tmp_path}/{k}_robot"] for k in (2, 10)]
    assert commands(["-m", "stage=still", folder]) == runs
    for typed in ("seed=1,2", "experiment=ablation_table", "stage=report"):
        assert commands([typed, folder]) == [[typed, folder]]


def test_a_job_of_an_experiment_that_sweeps_does_not_start_its_sweep(devrf, run, edited):
    edited(lambda entry: entry["command"].update({"/experiment": "ablation_table"}))
    assert devrf("stage=still", "still.height=20", "hydra.run.dir=run").status == 0
    assert (run / "images").is_dir()


def test_a_motion_learned_on_a_checkpoint_knows_the_whole_of_it(devrf, run, tmp_path):
    base = run / "checkpoints" / "canonical.ckpt"
    again = ("stage=deformation", f"ckpt={base}", "hydra.run.dir=other", "seed=3")
    assert devrf(*again).status == 0
    learned = read_checkpoint_file(tmp_path / "other" / "checkpoints" / "deformation.ckpt")
    first = read_checkpoint_file(base)["devrf"]
    assert first["command"]["field.width"] == 16 and first["command"]["data.width"] == 24
    assert learned["devrf"]["command"] == {**first["command"], "seed": 3}


def test_what_a_checkpoint_keeps_of_a_command_is_plain(devrf, tiny, tmp_path, monkeypatch):
    (tmp_path / "a b").mkdir()
    kept: list[dict] = []
    monkeypatch.setitem(STEPS, "inspect", lambda run: kept.append(run.command))
    typed = ("data=inward", "data.root='a b'", "data.downscale=${seed}", "experiment=cpu_small")
    of_the_command = (
        "stage=inspect",
        "still.time=1",
        "logger=csv",
        "viewer.port=5",
        "~callbacks.training_curve",
    )
    outcome = devrf(*typed, *of_the_command, "seed=2", "hydra.run.dir=run")
    assert kept == [
        {
            **{"/data": "inward", "/experiment": "cpu_small", "seed": 2},
            **{"data.root": str(tmp_path / "a b"), "data.downscale": 2},
        }
    ], outcome.err


def test_checkpoints_of_a_sweep_share_what_they_have_in_common(learned_by, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    one = learned_by({"facing": "forward"}, {"data.frames": 5, "seed": 5})
    other = learned_by({"facing": "forward"}, {"data.frames": 5, "seed": 4}, name="other.ckpt")
    found = composed(["-m", "stage=still", f"ckpt='{one},{other}'"])
    assert found.hydra.sweeper.params is None
    words = completed(["-m", "stage=still", f"ckpt={one},{other}"]).words
    assert words[:2] == ["-m", "facing=forward"]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        found = compose("config", [word for word in words[1:] if "ckpt=" not in word])
    assert (found.data.frames, found.seed) == (5, 0)


def test_another_option_of_a_group_begins_from_its_own_values(run, learned_by):
    there = [f"hydra.run.dir={run}", "stage=inspect"]
    settings = {"data.root": "gone", "data.downscale": 2, "seed": 1, "field.width": 8}
    learned_by({"data": "inward", "experiment": "cpu_small"}, settings)
    found = composed(there)
    assert (found.data.root, found.data.downscale, found.seed) == ("gone", 2, 1)
    assert found.field.width == 8 and found.hydra.runtime.choices.experiment == "cpu_small"
    found = composed([*there, "data=colmap", "data.root=here"])
    assert (found.data.root, found.seed, found.field.width) == ("here", 1, 8)
    assert found.data.downscale != 2
    # Another method has other settings.
    found = composed([*there, "method=dnerf"])
    assert (found.data.downscale, found.seed) == (2, 1)
    assert "field" not in found or found.field.width != 8


# What is no choice and no plain value is refused, whatever the file says

CODE = {"_target_": "sympy.sympify", "a": "__import__('os').system('touch PWNED')"}
# The word is put together of two settings once the text is read as a mapping.
TEXT = '${oc.decode:"{${aa}${bb}: sympy.sympify, a: 1}"}'


def nested(depth: int) -> object:
    """Lists within lists."""
    value: object = 1
    for _ in range(depth):
        value = [value]
    return value


HOSTILE = {
    "a list without end": ({}, {"data.test_times": [0] * 2000}),
    "keys without end": ({}, {f"data.k{k}": 0 for k in range(2000)}),
    "a text without end": ({}, {"data.root": "a b " * 10**5}),
    "a word that is put together": (
        {},
        {"aa": "_tar", "bb": "get_", "canonical": TEXT},
    ),
    "an interpolation": ({}, {"data.root": "${oc.env:HOME}"}),
    "an interpolation in a list": ({}, {"schedule.canonical.upsample_at": [1, ["${seed}"]]}),
    "a part": ({}, {"canonical": CODE}),
    "a part within": ({}, {"schedule": {"canonical": {"x": [CODE]}}}),
    "the key of a part": ({}, {"canonical._target_": "sympy.sympify"}),
    "a path as a choice": ({"data": "../../../../evil"}, {}),
    "a folder within a group": ({"data": "more/evil"}, {}),
    "a group of Hydra's": ({"hydra/launcher": "joblib"}, {}),
    "Hydra's own settings": ({}, {"hydra.searchpath": ["file:///evil"]}),
    "a logger": ({"logger": "wandb"}, {}),
    "a callback": ({}, {"callbacks.x": {"y": 1}}),
    "a list of defaults": ({}, {"defaults": ["/evil"]}),
    "an option that writes more": ({"data": "inward seed=1"}, {}),
    "a key that writes more": ({}, {"data.root=x +a": 1}),
    "a nest": ({}, {"data.name": nested(40)}),
    "a section that is no mapping": ({}, {"data": 3}),
    "an option that is none": ({"data": "null"}, {}),
    "a package": ({"data@callbacks.x": "procedural"}, {}),
    "a line of its own": ({}, {"data.name": "x\necho"}),
    "a place to write to": ({}, {"data": {"flow_cache": "/elsewhere"}}),
}


@pytest.mark.parametrize(("choices", "settings"), HOSTILE.values(), ids=list(HOSTILE))
def test_a_checkpoint_holds_names_of_options_and_plain_values(run, learned_by, choices, settings):
    evil = learned_by(choices, settings)
    for named in (f"hydra.run.dir={run}", f"ckpt={evil}"):
        with pytest.raises(DevrfError, match=f"^{evil}: "):
            completed(["stage=still", named])


@pytest.mark.parametrize(
    "words",
    [
        [f"data.test_times={[0] * 2000}"],
        [f"+data.k{k}=0" for k in range(2000)],
        [f"data.root='{'a b ' * 10**5}'"],
    ],
)
def test_a_command_without_end_is_not_parsed(words):
    with pytest.raises(DevrfError, match="^the command: more than 1000 values"):
        completed(words)


@pytest.mark.parametrize("name", ["a word that is put together", "a path as a choice", "a part"])
def test_a_checkpoint_that_chooses_code_is_one_line(devrf, run, learned_by, tmp_path, name):
    (tmp_path / "evil.yaml").write_text(json.dumps(CODE))
    learned_by(*HOSTILE[name])
    outcome = devrf("stage=still", "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: run/checkpoints/deformation.ckpt: ")
    assert not list(tmp_path.rglob("PWNED")) and not (run / "images").exists()


@pytest.mark.parametrize(
    "path",
    [
        *("os.system", "sympy.sympify", "torch.nn.Linear", "devrf.methods.devrf.model.partial"),
        *("devrf.methods.devrf.extensions.tracks.StartAlongFlow", "evil.Model", "..x", "", None),
    ],
)
@pytest.mark.parametrize("key", ["class", "color_residual"])
def test_a_checkpoint_names_no_class_but_a_method_s(
    devrf, edited, tmp_path, monkeypatch, path, key
):
    (tmp_path / "evil.py").write_text("open('PWNED', 'w')\nclass Model: from_config = print")
    monkeypatch.syspath_prepend(tmp_path)
    if key == "color_residual" and not path:
        return  # there is none
    evil = edited(lambda entry: entry["model"].update({key: path}))
    if path == "evil.Model":
        outcome = devrf("stage=still", f"ckpt={evil}")
        assert outcome.status == 2 and outcome.err.count("\n") == 1
    else:
        with pytest.raises(DevrfError):
            load_checkpoint(evil)
    assert not list(tmp_path.rglob("PWNED"))


WRITTEN = ["run.log", ".hydra", ".devrf", ".hydra/config.yaml", ".devrf/process.txt"]
WRITTEN += [
    "metrics.json",
    "frames.csv",
    "images",
    "videos",
    "logs",
    "logs/pipeline",
    "export",
    "export/points",
    "paths",
    "notes",
    "tensorboard/hparams.yaml",
]


DEEP = "[" * 200_000
FOREIGN = {
    "deep scores": ("metrics.json", DEEP),
    "scores that are none": ("metrics.json", "[]"),
    "deep notes": (".devrf/done.json", DEEP),
    "endless notes": (".devrf/done.json", " " * (LARGEST_RECORD + 1)),
    "notes of no digest": (".devrf/done.json", '{"render": [3]}'),
}


@pytest.mark.parametrize(("name", "text"), FOREIGN.values(), ids=list(FOREIGN))
def test_a_damaged_record_is_passed_over_or_one_line(devrf, trained, tmp_path, name, text):
    shutil.copytree(trained[0], tmp_path / "run")
    (tmp_path / "run" / name).write_text(text)
    quick = ("evaluation.metrics=[]", "video.frames=1", "video.height=24")
    outcome = devrf("hydra.run.dir=run", *(quick if "done" in name else ()))
    said = f"devrf: {tmp_path / 'run' / name}: damaged; remove it, and the run is scored again\n"
    assert (outcome.status, outcome.err) in ((0, ""), (2, said))
    if name == "metrics.json":
        assert devrf("stage=report", "report.runs=run", "hydra.run.dir=other").status == 2


TABLES = {
    "bytes": b"step,\xff\n1,2\n",
    "cells of no column": b"step,a\n1,2,3\n",
    "a cell without end": b"a,b\n" + b"x" * 200_000 + b",2\n",
    "a step that is no number": b"step,deformation/loss\nx,2\n",
}


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_a_damaged_table_of_curves_is_one_line(devrf, run, table):
    (run / "checkpoints" / "deformation.ckpt").unlink()
    (run / "logs" / "pipeline").mkdir(parents=True)
    (run / "logs" / "pipeline" / "metrics.csv").write_bytes(table)
    outcome = devrf("hydra.run.dir=run", "logger=csv")
    said = "run/logs/pipeline/metrics.csv: damaged; remove it, and curves begin anew\n"
    assert outcome.status == 2 and outcome.err.count("\n") == 1 and outcome.err.endswith(said)


def test_a_message_that_quotes_a_file_leaves_the_terminal_alone(devrf, edited):
    evil = edited(lambda entry: entry["model"].update({"class": "x\x1b]0;pwned\x07.Y\n.Z"}))
    outcome = devrf("stage=still", f"ckpt={evil}")
    assert outcome.status == 2 and outcome.err.rstrip("\n").isprintable()


@pytest.mark.parametrize("name", WRITTEN)
def test_a_link_is_refused_wherever_a_run_writes(tmp_path, name):
    (tmp_path / "run" / name).parent.mkdir(parents=True)
    (tmp_path / "run" / name).symlink_to(tmp_path / "else")
    with pytest.raises(DevrfError, match=f"run/{name}: a link or a pipe; remove it"):
        refuse_links(tmp_path / "run")


@pytest.mark.parametrize("name", ["run.log", ".hydra", ".devrf/process.txt"])
def test_nothing_is_written_through_a_link(devrf, run, tmp_path, name):
    (tmp_path / "else").mkdir()
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(tmp_path / "else")
    outcome = devrf("stage=still", "hydra.run.dir=run")
    said = f"devrf: run/{name}: a link or a pipe; remove it: devrf writes there\n"
    assert (outcome.status, outcome.out, outcome.err) == (2, "", said)
    assert not list((tmp_path / "else").iterdir())


def test_nothing_of_a_sweep_is_written_through_a_link(devrf, tmp_path, tiny):
    (tmp_path / "sweep" / "0_robot_seed_1" / ".hydra").mkdir(parents=True)
    (tmp_path / "sweep" / "0_robot_seed_1" / ".hydra" / "config.yaml").symlink_to(tmp_path / "x")
    outcome = devrf("-m", *tiny, "seed=1,2", "stage=inspect", "hydra.sweep.dir=sweep")
    assert outcome.status == 2 and "a link or a pipe" in outcome.err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", ["multirun.yaml", "optimization_results.yaml", "report/figures"])
def test_a_link_at_the_top_of_a_sweep_is_refused(devrf, tmp_path, tiny, name):
    (tmp_path / "sweep" / name).parent.mkdir(parents=True)
    (tmp_path / "sweep" / name).symlink_to(tmp_path / "x")
    outcome = devrf("-m", *tiny, "seed=1,2", "stage=inspect", "hydra.sweep.dir=sweep")
    said = f"devrf: sweep/{name}: a link or a pipe; remove it: devrf writes there\n"
    assert (outcome.status, outcome.err) == (2, said)
    assert not (tmp_path / "x").exists() and len(list((tmp_path / "sweep").iterdir())) == 1


def test_outputs_on_another_disk_and_a_linked_checkpoint_are_used(devrf, run, tmp_path):
    (run / "checkpoints" / "deformation.ckpt").rename(tmp_path / "other.ckpt")
    (run / "checkpoints" / "deformation.ckpt").symlink_to(tmp_path / "other.ckpt")
    (tmp_path / "disk").mkdir()
    run.rename(tmp_path / "disk" / "run")
    (tmp_path / "outputs").symlink_to(tmp_path / "disk")
    assert devrf("stage=still", "still.height=20", "hydra.run.dir=outputs/run").status == 0
    assert list((tmp_path / "disk" / "run" / "images").glob("still*.png"))


def test_a_pipe_is_no_checkpoint(devrf, run):
    os.mkfifo(run / "checkpoints" / "later.ckpt")
    assert devrf("stage=still", "still.height=20", "hydra.run.dir=run").status == 0
    outcome = devrf("stage=still", "ckpt=run/checkpoints/later.ckpt")
    assert outcome.status == 2 and outcome.err.count("\n") == 1

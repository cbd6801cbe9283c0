"""The package of docs/extending.md, installed as it is printed, and used from another folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from devrf.cli.config import config_folder
from devrf.cli.config_check import CHANGES
from devrf.scenes.export import export

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
TINY = "data.train_views=2 data.frames=3 ray_stage.schedule.iterations=4 ray_stage.schedule.rays=32"
MORE = (
    "ray_stage.model.settings.width=8 video.frames=2 video.height=16 trainer=cpu hydra.run.dir=run"
)


@pytest.fixture
def place(tmp_path: Path, tiny_scene) -> Path:
    """A folder with the package in ``site``, and a scene in ``scene``."""
    section = PAGE.read_text().split("{ #plugin }")[1]
    files = re.findall(r"`([\w./]+)`[^`]*?:\n\n```\w+\n(.*?)```", section, re.DOTALL)
    lines = sum(len(content.strip().splitlines()) for _, content in files)
    assert len(files) == 8 and lines <= 65
    for name, content in files:
        (tmp_path / "stiff" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "stiff" / name).write_text(content)
    how = ("--no-deps", "--no-build-isolation", "--quiet", "--target", "site", "./stiff")
    subprocess.run([sys.executable, "-m", "pip", "install", *how], cwd=tmp_path, check=True)
    export(tiny_scene, tmp_path / "scene")
    (tmp_path / "scene" / "lab.json").write_text("{}")
    return tmp_path


def test_its_method_reader_and_experiment_are_devrfs(place, warm_with):
    with warm_with(place / "site") as warm:

        def command(*typed):
            done = warm(place, *typed)
            assert done.status == 0, done.out
            return done.out

        learn = ("experiment=stiff_small", "data.root=scene", *TINY.split(), *MORE.split())
        assert "scene: the layout of the lab (data=lab)" in command(*learn)
        # A later command, and the checkpoint alone, know it.
        said = command("stage=still", "still.height=16", "hydra.run.dir=run")
        assert "/experiment" not in said and "experiment=stiff_small" in said
        command("stage=still", "still.height=16", "ckpt=run/checkpoints/joint.ckpt")
    assert len(list((place / "run" / "images").glob("still*_depth.png"))) == 2


def test_configs_alone_need_no_package(devrf, tmp_path):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    mine = "# @package _global_\ndefaults: [quickstart]\nseed: 7\n"
    (tmp_path / "mine" / "experiment" / "seven.yaml").write_text(mine)
    for where in (["--config-dir", "mine"], ["hydra.searchpath=[file://mine]"]):
        said = devrf(*where, "experiment=seven", "--cfg", "job")
        assert said.status == 0 and "seed: 7" in said.out


@pytest.mark.parametrize(
    ("group", "content", "key"),
    [
        ("method", "defaults: [devrf]\nmethod: own\n", "method.method"),
        ("experiment", "schedule: {seconds: 60}\n", "experiment.schedule.seconds"),
    ],
)
def test_a_config_of_the_whole_without_the_line_that_says_so(devrf, tmp_path, group, content, key):
    (tmp_path / "mine" / group).mkdir(parents=True)
    (tmp_path / "mine" / group / "own.yaml").write_text(content)
    outcome = devrf("--config-dir", "mine", f"{group}=own")
    said = f"a file of {group}=NAME begins with the line '# @package _global_'"
    expected = f"devrf: {key}: no part reads it; {said}\n"
    assert (outcome.status, outcome.err) == (2, expected)


def test_groups_of_configs_of_the_whole_are_known():
    files = config_folder().glob("*/*.yaml")
    groups = {file.parent.name for file in files if "@package _global_" in file.read_text()}
    assert groups == {"method", "schedule", *CHANGES}

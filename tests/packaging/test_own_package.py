"""The package of docs/extending.md, installed as it is printed, and used from another folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import devrf

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
TINY = "data.train_views=2 data.frames=3 ray_stage.schedule.iterations=4 ray_stage.schedule.rays=32"
MORE = (
    "ray_stage.model.settings.width=8 video.frames=2 video.height=16 trainer=cpu hydra.run.dir=run"
)
SCENE = (
    "data.width=24 data.height=20 data.static_views=6 data.static_test_views=2 data.supersample=1"
)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package in ``site``, and a scene in ``scene``."""
    folder = tmp_path_factory.mktemp("own")
    section = PAGE.read_text().split("{ #plugin }")[1]
    files = re.findall(r"`([\w./]+)`[^`]*?:\n\n```\w+\n(.*?)```", section, re.DOTALL)
    lines = sum(len(content.strip().splitlines()) for _, content in files)
    assert len(files) == 8 and lines <= 65
    for name, content in files:
        (folder / "stiff" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "stiff" / name).write_text(content)
    how = ("--no-deps", "--no-build-isolation", "--quiet", "--target", "site", "./stiff")
    subprocess.run([sys.executable, "-m", "pip", "install", *how], cwd=folder, check=True)
    command(folder, *SCENE.split(), *TINY.split()[:2], "stage=prepare", "data.export=scene")
    (folder / "scene" / "lab.json").write_text("{}")
    return folder


def command(folder: Path, *typed: str) -> str:
    """What ``python -m devrf`` says in ``folder``, which ends well."""
    source = str(Path(devrf.__file__).parents[1])
    path = os.pathsep.join([source, str(folder / "site"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "devrf", *typed],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "HYDRA_FULL_ERROR": "0"},
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_its_method_reader_and_experiment_are_devrfs(place: Path) -> None:
    said = command(place, "experiment=stiff_small", "data.root=scene", *TINY.split(), *MORE.split())
    assert "scene: the layout of the lab (data=lab)" in said
    # A later command, and the checkpoint alone, know it.
    said = command(place, "stage=still", "still.height=16", "hydra.run.dir=run")
    assert "/experiment" not in said and "experiment=stiff_small" in said
    command(place, "stage=still", "still.height=16", "ckpt=run/checkpoints/joint.ckpt")
    assert len(list((place / "run" / "images").glob("still*_depth.png"))) == 2


def test_configs_alone_need_no_package(place: Path) -> None:
    (place / "mine" / "experiment").mkdir(parents=True)
    mine = "# @package _global_\ndefaults: [quickstart]\nseed: 7\n"
    (place / "mine" / "experiment" / "seven.yaml").write_text(mine)
    for where in (["--config-dir", "mine"], ["hydra.searchpath=[file://mine]"]):
        assert "seed: 7" in command(place, *where, "experiment=seven", "--cfg", "job")

"""``stage=view``, ``viewer=true`` and ``video.path``: as a user calls them."""

from __future__ import annotations

import ast
import json
import logging
import os
import shutil
import signal
import socket
import threading
import time
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
import trimesh

import devrf as package
from devrf.apps.keyframes import CameraPath, Keyframe, write_path
from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.drawing import Drawing, Shot
from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.rendering.renderer import Renderer


@pytest.fixture
def port() -> int:
    """A port that is free."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@pytest.fixture
def viser() -> None:
    pytest.importorskip("viser", reason="the viewer's extra is not installed")


def ended_by(number: int, port: int) -> threading.Thread:
    """Sends this process a signal once something listens on ``port``, 60 s later at most."""

    def send() -> None:
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        time.sleep(0.3)  # the page is there before it is served
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_a_signal_and_ends_well(devrf, tmp_path, trained, viser, port, number):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    sender = ended_by(number, port)
    outcome = devrf("stage=view", f"ckpt={checkpoint}", f"viewer.port={port}", "hydra.run.dir=run")
    sender.join()
    assert (outcome.status, outcome.err) == (0, "")
    assert f"http://127.0.0.1:{port}" in outcome.out and "the viewer has ended" in outcome.out
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
    # It is no run: beside its log it leaves nothing, not even a config.
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {"run.log"}


def test_a_port_in_use_is_said_in_one_line(devrf, tmp_path, tiny, trained, viser):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    with socket.create_server(("127.0.0.1", 0)) as other:
        used = other.getsockname()[1]
        for command in (("stage=view", f"ckpt={checkpoint}"), ("stage=canonical", "viewer=true")):
            outcome = devrf(*tiny, *command, f"viewer.port={used}", "hydra.run.dir=run")
            assert outcome.status == 2 and outcome.err.count("\n") == 1
            assert outcome.err.startswith(f"devrf: viewer.port: {used} on 127.0.0.1 is in use")
    assert not list(tmp_path.iterdir())


def test_without_a_checkpoint_it_says_so_in_one_line(devrf, tmp_path, viser, port):
    outcome = devrf("stage=view", "hydra.run.dir=run", f"viewer.port={port}")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "no such checkpoint; run stage=" in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "setting", "instead"),
    [
        (["stage=view"], "stage=view", "stage=render"),
        (["viewer=true"], "viewer=true", "viewer=false"),
    ],
)
def test_the_missing_extra_is_named(devrf, tmp_path, monkeypatch, command, setting, instead):
    monkeypatch.setattr("devrf.cli.config_check.find_spec", lambda package: None)
    outcome = devrf(*command)
    expected = f'devrf: {setting}: viser is not installed; run pip install "devrf[viewer]", or set'
    assert (outcome.status, outcome.err) == (2, f"{expected} {instead}\n")
    assert not list(tmp_path.iterdir())


def imported(file: Path) -> set[str]:
    """The modules that a file imports when it is loaded."""
    found = set[str]()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{name.name}" for name in node.names}
    return found


def test_the_viewer_is_not_loaded_without_being_asked_for():
    source, seen = Path(package.__file__).parents[1], set[str]()
    waiting = ["devrf.__main__", "devrf.cli.main", "devrf.cli.run", "devrf.callbacks"]
    while waiting:
        module = waiting.pop()
        stem = source / module.replace(".", "/")
        for file in (stem.with_suffix(".py"), stem / "__init__.py"):
            if module not in seen and file.is_file():
                waiting += imported(file)
        seen.add(module)
    assert "devrf.apps.settings" in seen and "devrf.cli.render" in seen
    assert "viser" not in seen and "devrf.apps.viewer.session" not in seen


def test_a_run_learns_the_same_with_the_viewer_beside(devrf, tmp_path, tiny, viser, port):
    found = []
    for folder, more in (("with", ("viewer=true", f"viewer.port={port}")), ("without", ())):
        outcome = devrf(*tiny, "stage=canonical", f"hydra.run.dir={folder}", *more)
        assert (outcome.status, outcome.err) == (0, "")
        assert (f"http://127.0.0.1:{port}" in outcome.out) == bool(more)
        loaded = load_checkpoint(tmp_path / folder / "checkpoints" / "canonical.ckpt")
        assert "viewer" not in " ".join(loaded.metadata.command)
        found.append(loaded.model.canonical.density.values)
    assert found[0].equal(found[1])


def a_path(folder: Path) -> Path:
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0]])
    further = pose + torch.tensor([[0, 0, 0, 1.0], [0, 0, 0, 0], [0, 0, 0, 0]])
    keyframes = (Keyframe(pose, 40.0, 0.0, 0.0), Keyframe(further, 40.0, 1.0, 1.0))
    write_path(folder / "my path.json", CameraPath(keyframes, 2.0, 4.0), 30)
    return folder / "my path.json"


def test_keyframes_are_filmed(devrf, tmp_path, tiny, trained):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    file = a_path(tmp_path)
    outcome = devrf(*tiny, "stage=render", f"video.path={file}", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    (video,) = (tmp_path / "run" / "videos").iterdir()
    # Five pictures in a second, colour beside depth, 40 rows and twice as wide, below text.
    assert (video.name, iio.imread(video).shape[0]) == ("my path.mp4", 5)
    assert iio.imread(video).shape[2] == 2 * 80 + 4


@pytest.mark.parametrize("name", ["bullet_time", "time_freeze"])
def test_films_in_which_time_stands_still(devrf, tmp_path, tiny, trained, name):
    shutil.copytree(trained[0] / "checkpoints", tmp_path / "run" / "checkpoints")
    outcome = devrf(*tiny, "stage=render", f"video.path={name}", "hydra.run.dir=run")
    assert (outcome.status, outcome.err) == (0, "")
    (video,) = (tmp_path / "run" / "videos").iterdir()
    assert (video.name, len(iio.imread(video))) == (f"{name}.mp4", 4)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(None, "no such"), ({"keyframes": []}, "holds no camera path; expected keyframes")],
)
def test_a_path_that_is_none_is_refused_before_anything_is_learned(
    devrf, tmp_path, tiny, content, expected
):
    file = tmp_path / "path.json"
    if content is not None:
        file.write_text(json.dumps(content))
    outcome = devrf(*tiny, f"video.path={file}", "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {file}: ") and expected in outcome.err
    assert not (tmp_path / "run").exists()


def test_a_scene_that_cannot_be_read_is_shown_without_pictures(
    devrf, tmp_path, trained, viser, port
):
    checkpoint = trained[0] / "checkpoints" / "deformation.ckpt"
    sender = ended_by(signal.SIGTERM, port)
    where = (f"ckpt={checkpoint}", f"viewer.port={port}", "hydra.run.dir=run")
    outcome = devrf("stage=view", *where, "data=inward", "data.root=nowhere")
    sender.join()
    assert outcome.status == 0
    assert "its training cameras are shown without pictures" in outcome.out + outcome.err
    assert logging.getLogger("websockets").level == logging.WARNING

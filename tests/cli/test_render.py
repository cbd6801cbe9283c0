"""What is made of a learned scene: pictures, videos, geometry, the page in a browser."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
import trimesh

from devrf.apps.keyframes import CameraPath, Keyframe, write_path
from devrf.apps.settings import ViewerSettings
from devrf.apps.viewer.page import PageServer
from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.checkpoints.file_metadata import digest_of, latest_checkpoint
from devrf.cli.restore_config import parsed
from devrf.cli.view import serves_page
from devrf.errors import DevrfError


@pytest.fixture
def of_run(devrf, trained):
    """``of_run(*arguments)``: a command about the tiny run's last checkpoint, in ``run``."""
    checkpoint = f"ckpt={trained[0] / 'checkpoints' / 'deformation.ckpt'}"
    return lambda *arguments: devrf(checkpoint, "hydra.run.dir=run", *arguments)


# Stills and videos


def test_stills_in_any_size_read_no_scene_and_stay(of_run, tmp_path, monkeypatch):
    def unread(self):
        raise AssertionError("the scene was read")

    monkeypatch.setattr("devrf.data.rendered.ProceduralDataModule.load", unread)
    small = "still.height=70"
    for typed in (("still.time=0.3", small), (small,), (small,), (small, "still.view=1")):
        outcome = of_run("stage=still", *typed)
        assert (outcome.status, outcome.err) == (0, "")
    names = ("held_out_t0.3_h70", "held_out_t0.5_h70", "held_out_t0.5_h70_2", "1_t0.5_h70")
    made = {path.stem: path for path in (tmp_path / "run" / "images").iterdir()}
    assert set(made) == {f"still_{name}{kind}" for name in names for kind in ("", "_depth")}
    for name in ("still_held_out_t0.3_h70", "still_held_out_t0.3_h70_depth"):
        assert iio.imread(made[name]).shape == (70, 84, 3)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["still.view=6"], "still.view: expected held_out or 0 to 5, not 6"),
        (["data.frames=4"], "belongs to another scene"),
    ],
)
def test_no_such_still(of_run, tmp_path, arguments, expected):
    outcome = of_run("stage=still", *arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and expected in outcome.err
    assert not list(tmp_path.iterdir())


def test_videos_in_any_size(of_run, tmp_path):
    outcome = of_run("stage=render", "video.height=30")
    assert (outcome.status, outcome.err) == (0, "")
    # Three and two images of 30 x 36 pixels with a gap of 4, below a line of text.
    for name, width in (("held_out", 3 * 36 + 8), ("orbit", 2 * 36 + 4)):
        video = iio.imread(tmp_path / "run" / "videos" / f"{name}.mp4")
        assert video.shape == (4, 18 + 30, width, 3)


def test_keyframes_are_filmed(of_run, tmp_path):
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0]])
    further = pose + torch.tensor([[0, 0, 0, 1.0], [0, 0, 0, 0], [0, 0, 0, 0]])
    keyframes = (Keyframe(pose, 40.0, 0.0, 0.0), Keyframe(further, 40.0, 1.0, 1.0))
    file = tmp_path / "my path.json"
    write_path(file, CameraPath(keyframes, 2.0, 4.0), 30)
    outcome = of_run("stage=render", f"video.path={file}")
    assert (outcome.status, outcome.err) == (0, "")
    (video,) = (tmp_path / "run" / "videos").iterdir()
    # Five pictures in a second, colour beside depth, 40 rows and twice as wide, below text.
    assert (video.name, iio.imread(video).shape[0]) == ("my path.mp4", 5)
    assert iio.imread(video).shape[2] == 2 * 80 + 4


def test_a_video_in_which_time_stands_still(of_run, tmp_path):
    outcome = of_run("stage=render", "video.path=time_freeze")
    assert (outcome.status, outcome.err) == (0, "")
    (video,) = (tmp_path / "run" / "videos").iterdir()
    assert (video.name, len(iio.imread(video))) == ("time_freeze.mp4", 4)


def test_a_path_that_is_none_is_refused_before_anything_is_learned(devrf, tmp_path, tiny):
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"keyframes": []}))
    outcome = devrf(*tiny, f"video.path={file}", "hydra.run.dir=run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith(f"devrf: {file}: holds no camera path")
    assert not (tmp_path / "run").exists()


# Geometry: a few iterations make nothing that is more opaque.
FAINT = "export.threshold=5e-3"


def test_one_file_that_plays(of_run, tmp_path):
    outcome = of_run("stage=export", FAINT, "export.faces=200")
    assert (outcome.status, outcome.err) == (0, "")
    path = tmp_path / "run" / "export" / "scene.glb"
    assert f"vertices at 3 times written to {path}" in outcome.out
    (mesh,) = trimesh.load_scene(path).geometry.values()
    assert 100 < len(mesh.faces) <= 200


def test_nothing_is_exported_through_a_link(of_run, tmp_path):
    """A folder from somebody else may have links among its files."""
    (tmp_path / "out").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "out" / "points").symlink_to(tmp_path / "mine")
    outcome = of_run("stage=export", "export.into=out", "export.format=ply")
    assert outcome.status == 2 and "points: a link or a pipe; remove it" in outcome.err
    assert not [*(tmp_path / "mine").iterdir()]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "export.threshold: the field is empty"),
        (["export.content=points"], "points are written as ply, not as gltf; give export.format"),
    ],
)
def test_what_cannot_be_exported_is_said_in_one_line(of_run, tmp_path, arguments, expected):
    outcome = of_run("stage=export", *arguments)
    assert outcome.status == 2
    assert outcome.err.count("\n") == 1 and expected in outcome.err
    assert not (tmp_path / "run" / "export").exists()


@pytest.mark.parametrize("package", ["skimage", "trimesh", "pxr"])
def test_an_export_needs_the_packages_of_its_format_alone(of_run, tmp_path, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)  # importing it fails
    usd = ["export.format=usd"] if package == "pxr" else []
    outcome = of_run("stage=export", FAINT, *usd)
    said = f'devrf: {package} is not installed; run pip install "devrf[export]"\n'
    assert (outcome.status, outcome.err) == (2, said)
    assert not (tmp_path / "run").exists()


def test_an_export_of_numbers_alone_needs_no_package(of_run, monkeypatch):
    for package in ("skimage", "trimesh", "pxr"):
        monkeypatch.setitem(sys.modules, package, None)
    assert of_run("stage=export", "export.tracks=[[0,0,0]]", "export.format=csv").status == 0
    # Gaussians of a method's own are written by nothing but devrf.
    monkeypatch.setattr("devrf.cli.render.export_scene", lambda *arguments: None)
    assert of_run("stage=export", "export.format=splats").status == 0


# Without the scene


def test_a_run_is_shown_without_its_scene(devrf, tmp_path, tiny_data, short):
    assert devrf(*tiny_data, "stage=prepare", "prepare.into=walker").status == 0
    learned = ("experiment=cpu_small", "data.root=walker", "stage=canonical", "hydra.run.dir=run")
    assert devrf(*learned, *short).status == 0
    (tmp_path / "walker").rename(tmp_path / "moved")
    (tmp_path / "run").rename(tmp_path / "copy")
    said = {}
    for command in ("still still.height=20", f"export {FAINT}", "render", "canonical"):
        outcome = devrf("hydra.run.dir=copy", *f"stage={command}".split())
        assert (outcome.status, outcome.err) == (0, "")
        said[command] = outcome.out
    assert "canonical: learned already" in said["canonical"]
    # The video beside the truth, and scores, need images.
    outcome = devrf("stage=evaluate", "hydra.run.dir=copy")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert all("walker: no such folder" in text for text in (said["render"], outcome.err))
    videos, note = tmp_path / "copy" / "videos", tmp_path / "copy" / ".devrf" / "done.json"
    assert [video.name for video in videos.iterdir()] == ["orbit.mp4"] and not note.exists()
    assert devrf("stage=render", "hydra.run.dir=copy", "data.root=moved").status == 0
    assert (videos / "held_out.mp4").is_file() and note.exists()


# The page in a browser


@pytest.fixture
def port() -> int:
    """A port that is free."""
    pytest.importorskip("viser", reason="the viewer's extra is not installed")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


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


def test_it_serves_until_a_signal_and_ends_well(of_run, tmp_path, port):
    sender = ended_by(signal.SIGINT, port)
    outcome = of_run("stage=view", f"viewer.port={port}")
    sender.join()
    assert (outcome.status, outcome.err) == (0, "")
    assert f"http://127.0.0.1:{port}" in outcome.out and "the viewer has ended" in outcome.out
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
    # It is no run: it leaves what was served, no config and no log.
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["export"]


def test_the_page_of_a_run_is_served_before_anything_is_read(
    devrf, trained, tmp_path, port, monkeypatch
):
    shutil.copytree(trained[0], tmp_path / "run")

    def read(*arguments):
        raise AssertionError("the page was there already")

    monkeypatch.setattr("devrf.cli.run.run_stage", read)
    monkeypatch.setattr("devrf.checkpoints.checkpoint.metadata_of", read)
    sender = ended_by(signal.SIGINT, port)
    outcome = devrf("stage=view", "hydra.run.dir=run", f"viewer.port={port}")
    sender.join()
    assert (outcome.status, outcome.err) == (0, "")
    assert "the viewer has ended" in outcome.out
    outcome = devrf("stage=view", "hydra.run.dir=run", "viewer.port=page")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: viewer.port: expected a valid integer")


def test_a_page_is_that_of_the_last_checkpoint(trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained[0], run)
    typed = parsed(["stage=view", "hydra.run.dir=run", "viewer.port=8123"])
    assert serves_page(typed, run)
    assert not serves_page([*typed, *parsed(["viewer.renderer=server"])], run)
    assert not serves_page([*typed, *parsed(["data=flower"])], run)
    rest = run / "checkpoints" / "canonical.ckpt"
    os.utime(rest)  # as a copy of the folder may do
    assert serves_page(typed, run) and latest_checkpoint(run).name == "deformation.ckpt"
    content = read_checkpoint_file(rest)
    write_checkpoint_file(rest, {**content, "again": 1})  # learned since
    assert not serves_page(typed, run) and latest_checkpoint(run) == rest
    write_checkpoint_file(rest, content)
    assert serves_page(typed, run)
    progress = run / "checkpoints" / "deformation-progress-3.ckpt"
    (run / "checkpoints" / "deformation.ckpt").rename(progress)  # it does not say how far it is
    assert not serves_page(typed, run)
    progress.rename(run / "checkpoints" / "deformation.ckpt")
    assert serves_page(typed, run)
    page = run / "export" / "scene.html"
    page.write_text(page.read_text("utf-8").replace("const BUDGET", "const  BUDGET"), "utf-8")
    assert not serves_page(typed, run)  # of another version
    shutil.rmtree(run / "export" / "pictures")
    assert not serves_page(typed, run)


def test_a_page_whose_images_are_away_is_written_once(devrf, trained, tmp_path, port, monkeypatch):
    run = tmp_path / "run"
    shutil.copytree(trained[0], run)
    shutil.rmtree(run / "export")

    def away(self):
        raise DevrfError("robot: no such folder")

    def viewed(*arguments):
        sender = ended_by(signal.SIGINT, port)
        outcome = devrf("stage=view", "hydra.run.dir=run", f"viewer.port={port}", *arguments)
        sender.join()
        assert (outcome.status, outcome.err) == (0, "")
        return outcome.out

    with monkeypatch.context() as patch:
        patch.setattr("devrf.data.rendered.ProceduralDataModule.load", away)
        assert "no such folder; the cameras on its page are shown without pictures" in viewed()
        assert serves_page(parsed(["stage=view", "hydra.run.dir=run"]), run)
        assert "no such folder" not in viewed()
    pictures = run / "export" / "pictures"
    assert not any(pictures.iterdir())
    viewed("trainer.accelerator=cpu")  # more than the page is asked for, and the images are there
    assert any(pictures.iterdir())


def test_the_page_of_a_part_is_not_served_as_the_scene(trained, tmp_path, devrf):
    run = tmp_path / "run"
    shutil.copytree(trained[0], run)
    checkpoint = run / "checkpoints" / "deformation.ckpt"
    content = read_checkpoint_file(checkpoint)
    solid, moving = "canonical.density.values", "deformation.frames.forward_slices"
    for name, number in ((solid, 20.0), (moving, 0.3)):
        content["state_dict"][f"scene_model.{name}"]["kept"].fill_(number)
    write_checkpoint_file(checkpoint, content)
    outcome = devrf(
        *("stage=export", "hydra.run.dir=run", "export.format=html", "export.part=moving")
    )
    assert (outcome.status, outcome.err) == (0, "")
    page = (run / "export" / "scene.html").read_text("utf-8")
    assert digest_of(checkpoint) not in page and 'data-checkpoint=""' in page


def test_a_port_in_use_is_said_in_one_line(of_run, tmp_path, port):
    with socket.create_server(("127.0.0.1", 0)) as other:
        used = other.getsockname()[1]
        outcome = of_run("stage=view", f"viewer.port={used}")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: viewer.port: ") and str(used) in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_host_is_listened_to_or_refused_in_one_line(of_run, port):
    outcome = of_run("stage=view", f"viewer.host={'a' * 64}.com")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("devrf: viewer.host: cannot listen on aaaa")
    settings = ViewerSettings(host="::1", port=port)
    assert settings.address == f"http://[::1]:{port}"
    if not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    with closing(PageServer(settings, Path())), socket.create_connection(("::1", port)):
        pass


def test_a_run_learns_the_same_with_the_viewer_beside(devrf, tmp_path, tiny, port):
    found = []
    for folder, more in (("with", ("viewer=true", f"viewer.port={port}")), ("without", ())):
        outcome = devrf(*tiny, "stage=canonical", f"hydra.run.dir={folder}", *more)
        assert (outcome.status, outcome.err) == (0, "")
        assert (f"http://127.0.0.1:{port}" in outcome.out) == bool(more)
        loaded = load_checkpoint(tmp_path / folder / "checkpoints" / "canonical.ckpt")
        assert "viewer" not in " ".join(loaded.metadata.command)
        found.append(loaded.model.canonical.density.values)
    assert found[0].equal(found[1])

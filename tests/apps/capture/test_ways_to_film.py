"""From videos to a scene that is read: cameras around a thing, one moving camera, mattes.

Structure from motion itself is left out: its model is that of cameras on a ring.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.apps.settings import CaptureSettings
from devrf.data.recognised import recognised_datamodule
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras


def model_of_a_ring(folder, names):
    """A text model: cameras 4 units around 60 points near the origin, one an image."""
    angle = torch.arange(len(names)) * 2 * torch.pi / len(names)
    around = torch.stack([4 * angle.cos(), 4 * angle.sin(), torch.full_like(angle, 1.0)], dim=1)
    cameras = Cameras.looking_at(around, torch.zeros_like(around), focal=60.0, width=64, height=48)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
    shown = " ".join(f"1 1 {k}" for k in range(60))
    lines = []
    for k, (name, pose) in enumerate(zip(names, cameras.camera_to_world, strict=True), 1):
        turn = (pose[:, :3] * pose.new_tensor([1, -1, -1])).T
        axis = cv2.Rodrigues(turn.double().numpy())[0][:, 0]
        half = float(np.linalg.norm(axis)) / 2
        numbers = [np.cos(half), *(axis / (2 * half) * np.sin(half)), *(-turn @ pose[:, 3])]
        lines.append(f"{k} {' '.join(str(float(n)) for n in numbers)} 1 {name}\n{shown}\n")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    (folder / "images.txt").write_text("".join(lines))
    listed = (f"{k} {x} {y} {z} 0 0 0 0\n" for k, (x, y, z) in enumerate(points))
    (folder / "points3D.txt").write_text("".join(listed))
    return folder


@pytest.fixture(autouse=True)
def found(monkeypatch):
    """The names of images that structure from motion was asked for, call by call."""
    calls = []

    def reconstruct(images, work, moving, fixed, settings, advance):
        calls.append([*moving.names, *fixed])
        return model_of_a_ring(work / "models" / "0", calls[-1])

    monkeypatch.setattr("devrf.apps.capture.pipeline.check_library", lambda: None)
    monkeypatch.setattr("devrf.apps.capture.pipeline.reconstruct", reconstruct)
    return calls


@pytest.fixture
def footage(film, textured):
    """A walk of 12 frames, and three fixed views of six."""
    walk = film("walk.mp4", [textured(k) for k in range(12)])
    views = []
    for v in range(3):
        pictures = [textured(20 + v) for _ in range(6)]
        for t, side in enumerate((0, 9, 3, 15, 5, 7)):
            pictures[t][10:30, 10 + side : 30 + side] = (255, 40 * v, 0)
        views.append(film(f"view{v}.mp4", pictures))
    return walk, views


def read(folder):
    return recognised_datamodule(folder, flow="none").scene


def test_one_moving_camera_gives_each_frame_a_time(footage, tmp_path):
    into = tmp_path / "scene"
    scene_from_footage(CaptureSettings(views=[footage[0]], into=into, frames=12, holdout=4))
    scene = read(into)
    train, test = scene.dynamic.train, scene.dynamic.test
    assert (scene.kind, len(train), len(test)) == ("inward", 9, 3)
    times = torch.cat([train.times, test.times]).sort().values
    assert torch.allclose(times, torch.linspace(0, 1, 12), atol=1e-4)
    assert len(train.view.unique()) == 9  # the camera moves
    assert scene.static.train is train  # there is no static set


def test_cameras_around_a_thing_share_a_contracted_world(footage, tmp_path):
    into = tmp_path / "scene"
    walk, views = footage
    settings = {"static": walk, "views": views, "into": into, "offsets": [0, 0, 0]}
    scene_from_footage(CaptureSettings(**settings))
    scene = read(into)
    assert not scene.space.is_linear
    assert scene.bounds.reason == "scene_bounds in transforms.json"
    assert scene.bounds.box_source == "what the static cameras all see"
    assert [len(v) for v in (scene.dynamic.train, scene.dynamic.test)] == [12, 6]
    positions = scene.static.train.cameras.positions
    assert torch.allclose(positions.norm(dim=1), torch.full((len(positions),), 4.0), atol=1e-3)


def test_mattes_make_a_world_of_the_thing_and_are_found_again(footage, tmp_path, found):
    walk, views = footage
    grey = np.zeros((48, 64), np.uint8)
    grey[14:34, 22:42] = 255
    for video, count in ((walk, 12), *((view, 6) for view in views)):
        (tmp_path / "mattes" / video.stem).mkdir(parents=True)
        for k in range(count):
            cv2.imwrite(str(tmp_path / "mattes" / video.stem / f"{k:02}.png"), grey)
    into = tmp_path / "scene"
    settings = {"static": walk, "views": views, "into": into, "offsets": [0, 0, 0]}
    scene_from_footage(CaptureSettings(**settings, mattes=tmp_path / "mattes"))
    scene = read(into)
    assert scene.static.train.cut_out and scene.dynamic.test.cut_out
    assert scene.space.is_linear and scene.bounds.motion is not None
    # Found again as long as no matte changes.
    scene_from_footage(CaptureSettings(**settings, mattes=tmp_path / "mattes"))
    assert len(found) == 1
    cv2.imwrite(str(tmp_path / "mattes" / walk.stem / "00.png"), grey[:24])
    with pytest.raises(DevrfError, match=r"00\.png: 64x24 px, but its image"):
        scene_from_footage(CaptureSettings(**settings, mattes=tmp_path / "mattes"))
    assert not (into / "transforms.json").exists()


def test_subtraction_gives_the_box_of_what_moves(footage, tmp_path):
    walk, views = footage
    settings = {"static": walk, "views": views, "into": tmp_path / "scene", "offsets": [0, 0, 0]}
    scene_from_footage(CaptureSettings(**settings, mattes="subtract"))
    scene = read(tmp_path / "scene")
    assert not scene.static.train.has_alpha and not scene.space.is_linear
    assert scene.bounds.box_source == "scene_bounds in transforms.json"
    # Its box is another than that of all sparse points, 1.2 units wide and their margin.
    box = Box.of(scene.space.low, scene.space.high)
    assert box.longest > 2 and (tmp_path / "scene" / "images" / "view1").is_dir()

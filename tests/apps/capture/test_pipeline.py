"""From videos to a scene that is read; what is wrong with footage is said in one line.

Structure from motion itself is left out: its model is that of cameras on a ring, or in a row.
"""

from __future__ import annotations

import importlib.util

import cv2
import numpy as np
import pytest
import torch

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.apps.settings import CaptureSettings
from devrf.data.recorded import RecordedDataModule
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.formats.nerfstudio import NerfstudioReader

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def write_model(folder, names, positions, target, points):
    """A text model: a camera an image, looking at the target; all show all points."""
    cameras = Cameras.looking_at(
        positions, target.expand_as(positions), focal=60.0, width=64, height=48, up=UP
    )
    shown = " ".join(f"1 1 {k}" for k in range(len(points)))
    lines = []
    for k, (name, pose) in enumerate(zip(names, cameras.camera_to_world, strict=True), 1):
        turn = (pose[:, :3] * pose.new_tensor([1, -1, -1])).T
        axis = cv2.Rodrigues(turn.numpy())[0][:, 0]
        half = float(np.linalg.norm(axis)) / 2
        numbers = [np.cos(half), *(axis / (2 * half) * np.sin(half)), *(-turn @ pose[:, 3])]
        lines.append(f"{k} {' '.join(str(float(n)) for n in numbers)} 1 {name}\n{shown}\n")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 SIMPLE_PINHOLE 64 48 60 32 24\n")
    (folder / "images.txt").write_text("".join(lines))
    listed = (f"{k} {x} {y} {z} 0 0 0 0\n" for k, (x, y, z) in enumerate(points))
    (folder / "points3D.txt").write_text("".join(listed))
    return folder


def ring(folder, names):
    """Cameras 4 units around 60 points near the origin."""
    angle = torch.arange(len(names), dtype=torch.float64) * 2 * torch.pi / len(names)
    positions = torch.stack([4 * angle.cos(), 4 * angle.sin(), torch.ones_like(angle)], dim=1)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
    return write_model(folder, names, positions, torch.zeros(3).double(), points)


def row(folder, names):
    """Cameras before a wall, 20 to 30 units away."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-9, 20, -6], [9, 30, 6], (400, 3))
    positions = torch.tensor(generator.uniform([-3, -0.5, -2], [3, 0.5, 2], (len(names), 3)))
    return write_model(folder, names, positions, torch.tensor([0.0, 25, 0]).double(), points)


@pytest.fixture
def structure(monkeypatch):
    """Stands for structure from motion; holds the model, and the images asked for, by call."""

    class Structure:
        model, calls = staticmethod(ring), []

        def __call__(self, images, work, moving, fixed, settings):
            self.calls.append([*moving.names, *fixed])
            return self.model(work / "models" / "0", self.calls[-1])

    stand_in = Structure()
    stand_in.calls = []
    monkeypatch.setattr("devrf.apps.capture.pipeline.colmap", lambda: None)
    monkeypatch.setattr("devrf.apps.capture.pipeline.reconstruct", stand_in)
    return stand_in


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


@pytest.fixture
def capture(footage, structure, tmp_path):
    """Makes a scene of the walk and the views; returns it as it is read."""

    def run(**settings):
        walk, views = footage
        usual = {"static": walk, "views": views, "offsets": [0, 0, 0]}
        scene_from_footage(CaptureSettings(into=tmp_path / "scene", **{**usual, **settings}))
        return RecordedDataModule(NerfstudioReader, tmp_path / "scene", flow="none").scene

    return run


def test_one_moving_camera_gives_each_frame_a_time(capture, footage):
    scene = capture(static=None, views=[footage[0]], offsets=None, frames=12, holdout=4)
    train, test = scene.dynamic.train, scene.dynamic.test
    assert (scene.kind, len(train), len(test)) == ("inward", 9, 3)
    times = torch.cat([train.times, test.times]).sort().values
    assert torch.allclose(times, torch.linspace(0, 1, 12), atol=1e-4)
    assert len(train.view.unique()) == 9  # the camera moves
    assert scene.static.train is train  # there is no static set


def test_cameras_are_found_again_if_the_scene_is_said_to_move(capture, footage, structure):
    """Of a scene at rest what moves is not looked for."""
    capture(static=footage[0], views=[], offsets=None, holdout=4)
    assert capture(static=None, views=[footage[0]], offsets=None, holdout=4).moves
    assert len(structure.calls) == 2


def test_cameras_around_a_thing_share_a_contracted_world(capture):
    scene = capture()
    assert not scene.space.is_linear
    assert scene.bounds.reason == "scene_bounds in transforms.json"
    assert scene.bounds.box_source == "the common view of the static cameras"
    assert [len(v) for v in (scene.dynamic.train, scene.dynamic.test)] == [12, 6]
    distances = scene.static.train.cameras.positions.norm(dim=1)
    assert torch.allclose(distances, torch.full_like(distances, 4.0), atol=1e-3)


def test_cameras_in_a_row_share_ndc(capture, structure):
    structure.model = row
    scene = capture(holdout=6)
    assert scene.kind == "forward" and scene.space.near == 1.0
    # Static: the moving camera's, and the fixed views' first time.
    assert [len(v) for v in (scene.static.train, scene.static.test)] == [10 + 2, 2 + 1]
    assert scene.dynamic.train.times.unique().tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert all(name.startswith("images/view3/") for name in scene.dynamic.test.names)


def test_the_box_of_a_film_leaves_out_more_points(capture, footage, structure):
    structure.model = row  # the axes do not meet: points tell the box
    usual = capture(facing="inward", holdout=6)
    film = capture(static=None, views=[footage[0]], offsets=None, facing="inward", holdout=6)
    scenes = (usual, film)
    assert [scene.is_monocular for scene in scenes] == [False, True]
    wide, tight = (Box.of(scene.space.low, scene.space.high).longest for scene in scenes)
    assert 0.7 * wide < tight < 0.98 * wide


def test_alpha_masks_make_a_world_of_the_thing_and_are_found_again(
    capture, footage, structure, tmp_path
):
    grey = np.zeros((48, 64), np.uint8)
    grey[14:34, 22:42] = 255
    masks = tmp_path / "masks"
    for video, count in ((footage[0], 12), *((view, 6) for view in footage[1])):
        (masks / video.stem).mkdir(parents=True)
        for k in range(count):
            cv2.imwrite(str(masks / video.stem / f"{k:02}.png"), grey)
    scene = capture(alpha_masks=masks)
    assert scene.static.train.cut_out and scene.dynamic.test.cut_out
    assert scene.space.is_linear and scene.bounds.motion is not None
    capture(alpha_masks=masks)
    assert len(structure.calls) == 1  # found again as long as no mask changes
    cv2.imwrite(str(masks / "walk" / "00.png"), grey[:24])
    with pytest.raises(DevrfError, match=r"00\.png: "):
        capture(alpha_masks=masks)
    assert not (tmp_path / "scene" / "transforms.json").exists()


# What is wrong is said in one line, and nothing is left behind.


@pytest.fixture
def into(tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.apps.capture.pipeline.colmap", lambda: None)
    return tmp_path / "scene"


def refused(into, **settings):
    """The line that a capture ends with; its folder is no scene then."""
    with pytest.raises(DevrfError) as error:
        scene_from_footage(CaptureSettings(into=into, **settings))
    line = str(error.value)
    assert "\n" not in line and not (into / "transforms.json").exists()
    return line


def test_settings_that_do_not_go_together(into):
    with pytest.raises(DevrfError, match=r"^capture\.into: "):
        CaptureSettings(static="a.mp4").check()
    two = {"static": "s.mp4", "views": ["a.mp4", "b.mp4"]}
    one = {"static": "s.mp4", "views": ["a.mp4"]}
    for key, settings in (
        ("static", {}),
        ("offsets", {**two, "offsets": [0]}),
        ("test_view", {**two, "test_view": 3}),
        ("frames", {**two, "frames": 2}),
    ):
        assert refused(into, **settings).startswith(f"capture.{key}: ")
    assert CaptureSettings(static="a.mp4", views=["a.mp4"]).monocular
    assert not CaptureSettings(**one).monocular


def test_footage_or_a_folder_that_cannot_be_used(into, tmp_path, capfd):
    missing, damaged, used = tmp_path / "no.mp4", tmp_path / "damaged.mp4", tmp_path / "used"
    damaged.write_bytes(b"not a video" * 50)
    for path in (missing, damaged):
        assert refused(into, static=path).startswith(f"{path}: ")
    assert not into.exists() and capfd.readouterr().err == ""  # nor do libraries say anything
    used.mkdir()
    (used / "mine.txt").touch()
    assert refused(used, static=missing).startswith(f"{used}: is there already")


@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="needs devrf[capture]")
def test_footage_without_overlap(into, film):
    pictures = np.random.default_rng(0).integers(0, 256, (4, 96, 128, 3), dtype=np.uint8)
    static = film("static.mp4", list(pictures))
    assert refused(into, static=static).startswith(f"{static}: too few matches")
    # What the steps before have found stays.
    assert (into / "capture" / "images.json").is_file()


@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="needs devrf[capture]")
@pytest.mark.parametrize("plain_middle", [False, True])
def test_a_camera_that_stands_still_shows_no_depth(into, film, plain_middle):
    place = np.random.default_rng(0).integers(0, 256, (160, 240, 3), dtype=np.uint8)
    place = cv2.GaussianBlur(place, (0, 0), 1.5)
    place = np.clip(128 + 3.0 * (place.astype(np.float32) - 128), 0, 255).astype(np.uint8)
    if plain_middle:
        place[24:136, 36:204] = 128
    static = film("static.mp4", [place] * 6)
    assert refused(into, static=static).startswith(f"{static}: its frames show no depth: ")

"""The world of a captured scene, and its folder as the reader reads it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from devrf.apps.capture.pipeline import Shot, write_scene
from devrf.data.recognised import recognised_datamodule
from devrf.geometry.cameras import Cameras
from devrf.scenes.sparse_model import ModelCamera, ModelImage, SparseModel, normalised

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def model_of(positions, points, target=(0.0, 0.0, 0.0)):
    """A model of cameras at positions (N, 3) that look at the target; all show all points."""
    cameras = Cameras.looking_at(
        positions,
        positions.new_tensor(target).expand_as(positions),
        focal=50.0,
        width=64,
        height=48,
        up=UP,
    )
    images = []
    for k, pose in enumerate(cameras.camera_to_world):
        turn = (pose[:, :3] * pose.new_tensor([1, -1, -1])).T
        axis = cv2.Rodrigues(turn.numpy())[0][:, 0]
        angle = float(np.linalg.norm(axis))
        quaternion = (np.cos(angle / 2), *(axis / angle * np.sin(angle / 2)).tolist())
        moved = tuple((-turn @ pose[:, 3]).tolist())
        images.append(ModelImage(f"{k}.png", 1, quaternion, moved, np.arange(len(points))))
    camera = ModelCamera("SIMPLE_PINHOLE", (64, 48), (50.0, 32.0, 24.0))
    model = SparseModel(Path("model"), {1: camera}, tuple(images), points, np.arange(len(points)))
    return model, cameras.camera_to_world


@pytest.fixture
def wall():
    """Cameras before a wall, 20 to 30 units away in a world of any orientation."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-9, 20, -6], [9, 30, 6], (400, 3))
    positions = torch.tensor(generator.uniform([-3, -0.5, -2], [3, 0.5, 2], (9, 3)))
    return model_of(positions, points, (0.0, 25.0, 0.0))


def test_a_model_gives_its_cameras_back(wall):
    model, poses = wall
    assert torch.allclose(model.poses, poses, atol=1e-6)
    pose, point = poses[4], torch.from_numpy(model.points[7])
    assert float(model.depths(4)[7]) == pytest.approx(float((pose[:, 3] - point) @ pose[:, 2]))


def test_cameras_before_a_wall_get_the_world_of_their_average(wall):
    world = normalised(wall[0])
    assert (world.space, world.near, world.box) == ("ndc", 1.0, None)
    assert torch.allclose(world.poses[:, :, 3].mean(dim=0), torch.zeros(3).double(), atol=1e-6)
    mean = world.poses[:, :, 2].mean(dim=0)
    assert torch.allclose(mean / mean.norm(), UP, atol=1e-6)
    # All but the nearest hundredth are beyond 1/0.75; the wall is 1.5 times as deep as near.
    depths = -world.points[:, 2]
    assert float(depths.min()) == pytest.approx(4 / 3, rel=0.1)
    assert 1.3 < world.far / (4 / 3) < 1.7


def test_cameras_around_a_thing_have_it_in_the_middle_upright():
    angle = torch.arange(12, dtype=torch.float64) * np.pi / 6
    ring = torch.stack([30 * angle.cos(), 30 * angle.sin(), torch.full_like(angle, 8.0)], dim=1)
    middle = np.array([5.0, -2.0, 1.0])
    points = np.random.default_rng(1).uniform(-3, 3, (300, 3)) + middle
    shifted = ring + torch.from_numpy(middle)
    world = normalised(model_of(shifted, points, tuple(middle))[0])
    # The reader's box is better: what all cameras see.
    assert world.space == "contracted" and world.box is None
    assert torch.allclose(world.poses[:, :, 3].norm(dim=1), torch.tensor(4.0).double(), atol=1e-4)
    assert float(world.poses[:, :, 3].mean(dim=0)[2]) == pytest.approx(4 * 8 / 31.05, rel=1e-2)


def test_cameras_whose_axes_do_not_meet_are_around_the_points(wall):
    world = normalised(wall[0], "inward")
    assert world.space == "contracted" and world.box is not None
    low, high = world.points.amin(dim=0), world.points.amax(dim=0)
    assert bool((torch.tensor(world.box[0]) > 1.2 * low - 0.5).all())
    assert bool((torch.tensor(world.box[1]) < 1.2 * high + 0.5).all())


def test_a_written_scene_is_read_as_it_is(wall, tmp_path, textured):
    world = normalised(wall[0])
    lens = ModelCamera("SIMPLE_RADIAL", (64, 48), (50.0, 32.0, 24.0, 0.0)).keys
    shots = [Shot(f"static/{k}.png", world.poses[k], lens, 0.0, k == 5) for k in range(6)]
    for v, k in ((1, 6), (2, 7), (3, 8)):
        name = "view{}/{}.png"
        shots += [Shot(name.format(v, t), world.poses[k], lens, t / 2, v == 3) for t in range(3)]
    for k, one in enumerate(shots):
        path = tmp_path / "images" / one.name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), textured(k))
    write_scene(tmp_path, shots, world, "SIMPLE_RADIAL")
    scene = recognised_datamodule(tmp_path, flow="none").scene
    assert scene.kind == "forward" and scene.space.near == 1.0
    # Static: the moving camera's, and the fixed views' first moment.
    assert [len(v) for v in (scene.static.train, scene.static.test)] == [5 + 2, 1 + 1]
    assert [len(v) for v in (scene.dynamic.train, scene.dynamic.test)] == [2 * 3, 3]
    assert scene.dynamic.train.times.unique().tolist() == [0.0, 0.5, 1.0]
    assert set(scene.dynamic.test.names) == {f"images/view3/{t}.png" for t in range(3)}
    # In the world of the static cameras' average, which is nearly that of all.
    apart = scene.dynamic.train.cameras.positions[0] - scene.dynamic.test.cameras.positions[0]
    true = world.poses[6, :, 3] - world.poses[8, :, 3]
    assert float(apart.norm()) == pytest.approx(float(true.norm()), rel=1e-4)


def test_space_ndc_of_another_file_needs_a_near_plane(wall, tmp_path, textured):
    test_a_written_scene_is_read_as_it_is(wall, tmp_path, textured)
    listing = json.loads((tmp_path / "transforms.json").read_text())
    del listing["scene_bounds"]
    (tmp_path / "transforms.json").write_text(json.dumps(listing))
    with pytest.raises(Exception, match=r"data\.near: data\.space=ndc needs the distance"):
        _ = recognised_datamodule(tmp_path, flow="none", space="ndc").scene
    assert (
        recognised_datamodule(tmp_path, flow="none", space="ndc", near=0.9).scene.kind == "forward"
    )

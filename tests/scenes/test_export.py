"""The published layout on disk: what is written reads back exactly."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
from devrf.scenes.blender import BlenderReader
from devrf.scenes.export import export_blender
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Capture, Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    built = ProceduralScene(
        width=24, height=16, static_views=3, static_test_views=2, train_views=2, frames=3
    )()
    torch.set_num_threads(threads)
    return built


def test_what_is_exported_reads_back_exactly(scene, tmp_path):
    export_blender(scene, tmp_path / "new" / "robot")
    root = tmp_path / "new" / "robot"
    again = BlenderReader(root).read()
    for ours, read in (
        (scene.static.train, again.static.train),
        (scene.static.test, again.static.test),
        (scene.dynamic.train, again.dynamic.train),
        (scene.dynamic.test, again.dynamic.test),
    ):
        assert torch.equal(ours.pixels, read.pixels) and torch.equal(ours.times, read.times)
        assert torch.equal(ours.cameras.camera_to_world, read.cameras.camera_to_world)
        assert torch.equal(ours.cameras.focal[:, 0], read.cameras.focal[:, 0])
    ours_flow, flow = scene.dynamic.train.flow, again.dynamic.train.flow
    assert torch.equal(flow.vectors, ours_flow.vectors) and torch.equal(flow.valid, ours_flow.valid)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["robot"]
    moving = root / "dynamic_2views"
    # Images 0 and 1 are the two views at time 0.
    flows = sorted(p.name for p in (moving / "train_flow").iterdir())
    assert flows == ["002_bwd.npz", "003_bwd.npz", "004_bwd.npz", "005_bwd.npz"]
    # The layout's validation images are test images again.
    validation = json.loads((moving / "transforms_val.json").read_text())["frames"]
    test = json.loads((moving / "transforms_test.json").read_text())["frames"]
    assert [f["transform_matrix"] for f in validation] == [f["transform_matrix"] for f in test]


def test_dynamic_images_are_put_in_time_major_order(scene, tmp_path):
    view_major = torch.tensor([0, 2, 4, 1, 3, 5])
    shuffled = Capture(scene.dynamic.train[view_major], scene.dynamic.test)
    export_blender(replace(scene, dynamic=shuffled), tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
    for k in range(6):
        image = iio.imread(folder / "train" / f"r_{k:03d}.png")
        assert np.array_equal(image, scene.dynamic.train.pixels[k].numpy())


def test_without_flow_or_matte(scene, tmp_path):
    train = replace(scene.dynamic.train, flow=None, pixels=scene.dynamic.train.pixels[..., :3])
    export_blender(replace(scene, dynamic=Capture(train, scene.dynamic.test)), tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    assert not (folder / "train_flow").exists()
    image = iio.imread(folder / "train" / "r_000.png")
    assert image.shape == (16, 24, 4) and (image[..., 3] == 255).all()


def test_an_empty_folder_is_filled_and_a_used_one_is_kept(scene, tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "empty").mkdir()
    export_blender(scene, tmp_path / "empty")
    shutil.rmtree(tmp_path / "empty")
    (tmp_path / "robot" / "mine.txt").write_text("keep")
    with pytest.raises(DevrfError, match="robot"):
        export_blender(scene, tmp_path / "robot")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["mine.txt"]


@pytest.mark.parametrize("wrong", ["focal", "center"])
def test_intrinsics_beyond_one_angle_leave_nothing_behind(scene, tmp_path, wrong):
    cameras = scene.dynamic.train.cameras
    factor = torch.tensor([1.0, 1.01])
    bent = replace(cameras, **{wrong: getattr(cameras, wrong) * factor})
    train = replace(scene.dynamic.train, cameras=bent)
    with pytest.raises(DevrfError, match="camera_angle_x"):
        export_blender(
            replace(scene, dynamic=Capture(train, scene.dynamic.test)), tmp_path / "robot"
        )
    assert not list(tmp_path.iterdir())


def test_forward_facing_scenes_are_refused(scene, tmp_path):
    with pytest.raises(DevrfError, match="inward"):
        export_blender(replace(scene, kind="forward"), tmp_path / "robot")

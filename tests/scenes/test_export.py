"""The published layout on disk: what is written reads back exactly."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
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


def test_layout_is_the_published_one(scene: Scene, tmp_path: Path) -> None:
    export_blender(scene, tmp_path / "new" / "robot")
    root = tmp_path / "new" / "robot"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["robot"]
    assert sorted(p.name for p in root.iterdir()) == ["dynamic_2views", "static"]
    for part in root.iterdir():
        names = {p.name for p in part.iterdir() if p.is_file()}
        assert names == {f"transforms_{split}.json" for split in ("train", "val", "test")}
    flows = sorted(p.name for p in (root / "dynamic_2views" / "train_flow").iterdir())
    # Images 0 and 1 are the two views at time 0.
    assert flows == ["002_bwd.npz", "003_bwd.npz", "004_bwd.npz", "005_bwd.npz"]


def test_everything_reads_back_exactly(scene: Scene, tmp_path: Path) -> None:
    export_blender(scene, tmp_path / "robot")
    for part, capture in (("static", scene.static), ("dynamic_2views", scene.dynamic)):
        folder = tmp_path / "robot" / part
        for split, views in (("train", capture.train), ("test", capture.test)):
            content = json.loads((folder / f"transforms_{split}.json").read_text())
            focal = 24 / 2 / math.tan(content["camera_angle_x"] / 2)
            assert np.float32(focal) == views.cameras.focal[0, 0].numpy()
            assert len(content["frames"]) == len(views)
            for k, frame in enumerate(content["frames"]):
                assert frame["file_path"] == f"./{split}/r_{k:03d}"
                assert np.float32(frame["time"]) == views.times[k].numpy()
                matrix = np.array(frame["transform_matrix"], dtype=np.float32)
                assert np.array_equal(matrix[:3], views.cameras.camera_to_world[k].numpy())
                assert matrix[3].tolist() == [0, 0, 0, 1]
                image = iio.imread(folder / f"{frame['file_path']}.png")
                assert np.array_equal(image, views.pixels[k].numpy())


def test_flow_reads_back_exactly(scene: Scene, tmp_path: Path) -> None:
    export_blender(scene, tmp_path / "robot")
    flow = scene.dynamic.train.flow
    assert flow is not None
    for k in range(2, 6):
        path = tmp_path / "robot" / "dynamic_2views" / "train_flow" / f"{k:03d}_bwd.npz"
        with np.load(path) as stored:
            assert (stored["flow"].dtype, stored["flow"].shape) == (np.float32, (16, 24, 2))
            assert stored["mask"].dtype == bool
            assert np.array_equal(stored["flow"], flow.vectors[k].numpy())
            assert np.array_equal(stored["mask"], flow.valid[k].numpy())


def test_validation_repeats_the_first_test_views(scene: Scene, tmp_path: Path) -> None:
    export_blender(scene, tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    frames = json.loads((folder / "transforms_val.json").read_text())["frames"]
    assert len(frames) == 3
    for k, frame in enumerate(frames):
        image = iio.imread(folder / f"{frame['file_path']}.png")
        assert np.array_equal(image, scene.dynamic.test.pixels[k].numpy())


def test_dynamic_images_are_put_in_time_major_order(scene: Scene, tmp_path: Path) -> None:
    view_major = torch.tensor([0, 2, 4, 1, 3, 5])
    shuffled = Capture(scene.dynamic.train[view_major], scene.dynamic.test)
    export_blender(replace(scene, dynamic=shuffled), tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
    for k in range(6):
        image = iio.imread(folder / "train" / f"r_{k:03d}.png")
        assert np.array_equal(image, scene.dynamic.train.pixels[k].numpy())


def test_without_flow_or_matte(scene: Scene, tmp_path: Path) -> None:
    train = replace(scene.dynamic.train, flow=None, pixels=scene.dynamic.train.pixels[..., :3])
    export_blender(replace(scene, dynamic=Capture(train, scene.dynamic.test)), tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    assert not (folder / "train_flow").exists()
    image = iio.imread(folder / "train" / "r_000.png")
    assert image.shape == (16, 24, 4) and (image[..., 3] == 255).all()


def test_a_used_folder_is_refused_and_kept(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "mine.txt").write_text("keep")
    with pytest.raises(DevrfError, match="robot"):
        export_blender(scene, tmp_path / "robot")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["mine.txt"]


def test_an_empty_folder_is_filled(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    export_blender(scene, tmp_path / "robot")
    assert (tmp_path / "robot" / "static" / "transforms_train.json").is_file()


@pytest.mark.parametrize("wrong", ["focal", "center"])
def test_intrinsics_beyond_one_angle_leave_nothing_behind(
    scene: Scene, tmp_path: Path, wrong: str
) -> None:
    cameras = scene.dynamic.train.cameras
    factor = torch.tensor([1.0, 1.01])
    bent = replace(cameras, **{wrong: getattr(cameras, wrong) * factor})
    train = replace(scene.dynamic.train, cameras=bent)
    with pytest.raises(DevrfError, match="camera_angle_x"):
        export_blender(
            replace(scene, dynamic=Capture(train, scene.dynamic.test)), tmp_path / "robot"
        )
    assert not list(tmp_path.iterdir())


def test_forward_facing_scenes_are_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(DevrfError, match="inward"):
        export_blender(replace(scene, kind="forward"), tmp_path / "robot")

"""The published layouts on disk: what is written reads back the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
from devrf.scenes.export import export, export_blender
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ProceduralScene(
        width=24, height=16, static_views=3, static_test_views=2, train_views=2, frames=3
    )()


def with_train(scene: Scene, **change: Any) -> Scene:
    """The scene with another moving training capture."""
    train = replace(scene.dynamic.train, **change)
    return replace(scene, dynamic=replace(scene.dynamic, train=train))


def test_what_is_exported_reads_back_exactly(scene: Scene, tmp_path: Path) -> None:
    root = tmp_path / "new" / "robot"
    export(scene, root)
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
    validation, test = (
        json.loads((moving / f"transforms_{split}.json").read_text())["frames"]
        for split in ("val", "test")
    )
    assert [f["transform_matrix"] for f in validation] == [f["transform_matrix"] for f in test]


def test_dynamic_images_are_put_in_time_major_order(scene: Scene, tmp_path: Path) -> None:
    shuffled = scene.dynamic.train[torch.tensor([0, 2, 4, 1, 3, 5])]
    export_blender(replace(scene, dynamic=replace(scene.dynamic, train=shuffled)), tmp_path / "new")
    folder = tmp_path / "new" / "dynamic_2views"
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
    for k, pixels in enumerate(scene.dynamic.train.pixels):
        assert np.array_equal(iio.imread(folder / "train" / f"r_{k:03d}.png"), pixels.numpy())


def test_without_flow_or_matte(scene: Scene, tmp_path: Path) -> None:
    opaque = scene.dynamic.train.pixels[..., :3]
    export_blender(with_train(scene, flow=None, pixels=opaque), tmp_path / "robot")
    folder = tmp_path / "robot" / "dynamic_2views"
    assert not (folder / "train_flow").exists()
    image = iio.imread(folder / "train" / "r_000.png")
    assert image.shape == (16, 24, 3)


def test_an_empty_folder_is_filled_and_a_used_one_is_kept(scene: Scene, tmp_path: Path) -> None:
    used, empty = tmp_path / "used", tmp_path / "empty"
    used.mkdir()
    empty.mkdir()
    export_blender(scene, empty)
    assert {p.name for p in empty.iterdir()} == {"static", "dynamic_2views"}
    (used / "mine.txt").write_text("keep")
    with pytest.raises(DevrfError, match="used"):
        export_blender(scene, used)
    assert [p.name for p in used.iterdir()] == ["mine.txt"]
    assert {p.name for p in tmp_path.iterdir()} == {"used", "empty"}


@pytest.mark.parametrize("wrong", ["focal", "center", "kind"])
def test_what_the_layout_cannot_hold_leaves_nothing_behind(
    scene: Scene, tmp_path: Path, wrong: str
) -> None:
    if wrong == "kind":
        bad, said = replace(scene, kind="forward"), "inward"
    else:
        cameras = scene.dynamic.train.cameras
        bent = {wrong: getattr(cameras, wrong) * torch.tensor([1.0, 1.01])}
        bad, said = with_train(scene, cameras=replace(cameras, **bent)), "camera_angle_x"
    with pytest.raises(DevrfError, match=said):
        export_blender(bad, tmp_path / "robot")
    assert not list(tmp_path.iterdir())

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
from devrf.scenes.export import export, export_blender, export_llff
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene
from devrf.scenes.scene import Capture, Scene, Views


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


@pytest.fixture(scope="module")
def facing() -> Scene:
    return ProceduralForwardScene(
        width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
    )()


def views_of(scene: Scene) -> list[Views]:
    return [v for capture in (scene.static, scene.dynamic) for v in (capture.train, capture.test)]


def test_what_is_exported_reads_back_the_same(facing: Scene, tmp_path: Path) -> None:
    export(facing, tmp_path / "scene")
    again = LlffReader(tmp_path / "scene").read()
    for ours, read in zip(views_of(facing), views_of(again), strict=True):
        assert torch.equal(ours.pixels, read.pixels)
        assert torch.equal(ours.times, read.times) and torch.equal(ours.view, read.view)
        camera = torch.arange(len(ours)).repeat_interleave(40 * 28)
        pixels = ours.cameras.pixel_grid().repeat(len(ours), 1)
        a, b = ours.cameras.rays(camera, pixels), read.cameras.rays(camera, pixels)
        torch.testing.assert_close(a.origins, b.origins, atol=1e-6, rtol=0)
        torch.testing.assert_close(a.directions, b.directions, atol=1e-6, rtol=0)
        # Points of the exact scene fall on the pixels that show them.
        assert ours.depth is not None
        points = a.at(torch.arange(len(a)), ours.depth.flatten())
        seen, depth = read.cameras.project(camera, points)
        torch.testing.assert_close(seen, pixels, atol=1e-3, rtol=0)
        assert bool((depth > 1.3).all())
    ours_flow, read_flow = facing.dynamic.train.flow, again.dynamic.train.flow
    assert ours_flow is not None and read_flow is not None
    assert torch.equal(ours_flow.vectors, read_flow.vectors)
    assert torch.equal(ours_flow.valid, read_flow.valid)
    assert again.space == facing.space
    assert again.bounds.box.low == pytest.approx(facing.bounds.box.low, abs=1e-5)
    assert again.bounds.box.high == pytest.approx(facing.bounds.box.high, abs=1e-5)


def test_the_layout_is_the_published_one(facing: Scene, tmp_path: Path):
    export(facing, tmp_path / "plush")
    root = tmp_path / "plush"
    assert sorted(p.name for p in root.iterdir()) == ["dynamic_4views", "static"]
    rows = np.load(root / "static" / "poses_bounds.npy")
    assert rows.shape == (10, 17)
    matrix = rows[:, :15].reshape(10, 3, 5)
    focal = float(facing.static.train.cameras.focal[0, 0])
    assert matrix[:, :, 4].tolist() == [[112, 160, pytest.approx(4 * focal)]] * 10
    # The first image is held out; down is against the camera's y axis, right along its x axis.
    first = facing.static.test.cameras.camera_to_world[0].numpy()
    assert np.array_equal(matrix[0, :, 0], -first[:, 1].astype(float))
    assert np.array_equal(matrix[0, :, 1], first[:, 0].astype(float))
    assert rows[:, 15].tolist() == [pytest.approx(4 / 3)] * 10
    moving = root / "dynamic_4views"
    assert np.load(moving / "poses.npy").shape == (4, 3, 5)
    assert np.load(moving / "poses.npy")[0, :, 4].tolist() == [28, 40, pytest.approx(focal)]
    assert np.load(moving / "bds.npy").shape == (4, 2)
    flows = sorted(p.name for p in (moving / "view2" / "images_4_flow").iterdir())
    assert flows == ["001_bwd.npz", "002_bwd.npz", "003_bwd.npz"]
    assert not (moving / "view4" / "images_4_flow").exists()


def test_what_llff_cannot_hold_leaves_nothing_behind(facing: Scene, tmp_path: Path) -> None:
    static, dynamic = facing.static, facing.dynamic
    cameras = dynamic.train.cameras

    def bent(**change: Any) -> Scene:
        train = replace(dynamic.train, cameras=replace(cameras, **change))
        return replace(facing, dynamic=Capture(train, dynamic.test))

    few = Capture(static.train, static.test[torch.tensor([0])])
    late = Capture(dynamic.train, replace(dynamic.test, times=dynamic.test.times**2))
    shaking = cameras.camera_to_world.clone()
    shaking[4, 0, 3] += 0.1
    for wrong, said in (
        (replace(facing, static=few), "every 8th"),
        (replace(facing, dynamic=Capture(dynamic.test, dynamic.train)), "one held-out view"),
        (replace(facing, dynamic=late), "no times"),
        (bent(focal=cameras.focal * torch.tensor([1.0, 1.01])), "one focal length"),
        (bent(center=cameras.center + 1), "middle"),
        (bent(camera_to_world=shaking), "stand still"),
        (replace(facing, kind="inward"), "forward-facing"),
    ):
        with pytest.raises(DevrfError, match=said):
            export_llff(wrong, tmp_path / "out")
        assert not list(tmp_path.iterdir())

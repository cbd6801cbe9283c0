"""The published forward-facing layout on disk: what is written reads back the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
from devrf.scenes.export import export, export_llff
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Capture, Scene, Views


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ProceduralForwardScene(
        width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
    )()


def views_of(scene: Scene) -> list[Views]:
    return [v for capture in (scene.static, scene.dynamic) for v in (capture.train, capture.test)]


def test_what_is_exported_reads_back_the_same(scene: Scene, tmp_path: Path) -> None:
    export(scene, tmp_path / "scene")
    again = LlffReader(tmp_path / "scene").read()
    for ours, read in zip(views_of(scene), views_of(again), strict=True):
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
    ours_flow, read_flow = scene.dynamic.train.flow, again.dynamic.train.flow
    assert ours_flow is not None and read_flow is not None
    assert torch.equal(ours_flow.vectors, read_flow.vectors)
    assert torch.equal(ours_flow.valid, read_flow.valid)
    assert again.space == scene.space
    assert again.bounds.box.low == pytest.approx(scene.bounds.box.low, abs=1e-5)
    assert again.bounds.box.high == pytest.approx(scene.bounds.box.high, abs=1e-5)


def test_the_layout_is_the_published_one(scene: Scene, tmp_path: Path):
    export(scene, tmp_path / "plush")
    root = tmp_path / "plush"
    assert sorted(p.name for p in root.iterdir()) == ["dynamic_4views", "static"]
    rows = np.load(root / "static" / "poses_bounds.npy")
    assert rows.shape == (10, 17)
    matrix = rows[:, :15].reshape(10, 3, 5)
    focal = float(scene.static.train.cameras.focal[0, 0])
    assert matrix[:, :, 4].tolist() == [[112, 160, pytest.approx(4 * focal)]] * 10
    # The first image is held out; down is against the camera's y axis, right along its x axis.
    first = scene.static.test.cameras.camera_to_world[0].numpy()
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


def test_what_the_layout_cannot_hold_leaves_nothing_behind(scene: Scene, tmp_path: Path) -> None:
    static, dynamic = scene.static, scene.dynamic
    cameras = dynamic.train.cameras

    def bent(**change: Any) -> Scene:
        train = replace(dynamic.train, cameras=replace(cameras, **change))
        return replace(scene, dynamic=Capture(train, dynamic.test))

    few = Capture(static.train, static.test[torch.tensor([0])])
    late = Capture(dynamic.train, replace(dynamic.test, times=dynamic.test.times**2))
    shaking = cameras.camera_to_world.clone()
    shaking[4, 0, 3] += 0.1
    for wrong, said in (
        (replace(scene, static=few), "every 8th"),
        (replace(scene, dynamic=Capture(dynamic.test, dynamic.train)), "one held-out view"),
        (replace(scene, dynamic=late), "no times"),
        (bent(focal=cameras.focal * torch.tensor([1.0, 1.01])), "one focal length"),
        (bent(center=cameras.center + 1), "middle"),
        (bent(camera_to_world=shaking), "stand still"),
        (replace(scene, kind="inward"), "forward-facing"),
    ):
        with pytest.raises(DevrfError, match=said):
            export_llff(wrong, tmp_path / "out")
        assert not list(tmp_path.iterdir())

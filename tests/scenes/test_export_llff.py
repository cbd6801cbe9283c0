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
from devrf.scenes.llff import LlffReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Capture, Scene, Views


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ProceduralForwardScene(
        width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
    )()


def views_of(scene: Scene) -> list[Views]:
    captures: list[Capture] = [scene.static, scene.dynamic]
    return [views for capture in captures for views in (capture.train, capture.test)]


def test_what_is_exported_reads_back_the_same(scene, tmp_path):
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
    ours_flow, read_flow = scene.dynamic.train.flow, again.dynamic.train.flow
    assert ours_flow is not None and read_flow is not None
    assert torch.equal(ours_flow.vectors, read_flow.vectors)
    assert torch.equal(ours_flow.valid, read_flow.valid)
    assert again.space == scene.space
    for corner in ("low", "high"):
        ours_corner = getattr(scene.bounds.box, corner)
        assert getattr(again.bounds.box, corner) == pytest.approx(ours_corner, abs=1e-5)


def test_points_of_the_exact_scene_fall_on_the_pixels_that_show_them(scene, tmp_path):
    export(scene, tmp_path / "scene")
    again = LlffReader(tmp_path / "scene").read()
    for ours, read in zip(views_of(scene), views_of(again), strict=True):
        assert ours.depth is not None
        camera = torch.arange(len(ours)).repeat_interleave(40 * 28)
        pixels = ours.cameras.pixel_grid().repeat(len(ours), 1)
        rays = ours.cameras.rays(camera, pixels)
        points = rays.at(torch.arange(len(rays)), ours.depth.flatten())
        seen, depth = read.cameras.project(camera, points)
        torch.testing.assert_close(seen, pixels, atol=1e-3, rtol=0)
        assert bool((depth > 1.3).all())


def refused_export(scene: Scene, folder: Path) -> str:
    with pytest.raises(DevrfError) as caught:
        export_llff(scene, folder / "out")
    assert not list(folder.iterdir())
    return str(caught.value)


def test_the_layout_is_the_published_one(scene, tmp_path):
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


def test_what_the_layout_cannot_hold_leaves_nothing_behind(scene, tmp_path):
    static, dynamic = scene.static, scene.dynamic

    def bent(**change: Any) -> Scene:
        cameras = replace(dynamic.train.cameras, **change)
        train = replace(dynamic.train, cameras=cameras)
        return replace(scene, dynamic=Capture(train, dynamic.test))

    few = Capture(static.train, static.test[torch.tensor([0])])
    assert "every 8th" in refused_export(replace(scene, static=few), tmp_path)
    two = Capture(dynamic.test, dynamic.train)
    assert "one held-out view" in refused_export(replace(scene, dynamic=two), tmp_path)
    late = Capture(dynamic.train, replace(dynamic.test, times=dynamic.test.times**2))
    assert "no times" in refused_export(replace(scene, dynamic=late), tmp_path)
    focal, center = dynamic.train.cameras.focal, dynamic.train.cameras.center
    wide = bent(focal=focal * torch.tensor([1.0, 1.01]))
    assert "one focal length" in refused_export(wide, tmp_path)
    assert "middle" in refused_export(bent(center=center + 1), tmp_path)
    shaking = dynamic.train.cameras.camera_to_world.clone()
    shaking[4, 0, 3] += 0.1
    assert "stand still" in refused_export(bent(camera_to_world=shaking), tmp_path)
    assert "forward-facing" in refused_export(replace(scene, kind="inward"), tmp_path)

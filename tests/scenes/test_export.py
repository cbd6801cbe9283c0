"""The published layouts on disk: what is written reads back the same."""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from devrf.cli.messages import one_line
from devrf.errors import DevrfError
from devrf.scenes.export import export, write_image
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Scene, Views


@pytest.fixture
def scene(tiny_scene: Scene) -> Scene:
    return tiny_scene


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


def test_positions_that_are_written_have_the_offset(scene: Scene, tmp_path: Path) -> None:
    far = replace(scene, offset=(500_000.0, 5_600_000.0, 200.0))
    export(far, tmp_path / "robot")
    file = tmp_path / "robot/static/transforms_train.json"
    frames = json.loads(file.read_text())["frames"]
    matrices = torch.tensor([f["transform_matrix"] for f in frames], dtype=torch.float64)
    place = scene.static.train.cameras.positions.double() + torch.tensor(far.offset).double()
    torch.testing.assert_close(matrices[:, :3, 3], place, rtol=1e-15, atol=0)
    again = BlenderReader(tmp_path / "robot").read()
    assert again.offset == far.offset
    torch.testing.assert_close(
        again.dynamic.train.cameras.camera_to_world, scene.dynamic.train.cameras.camera_to_world
    )


def test_an_empty_folder_is_filled_and_a_used_one_is_kept(scene: Scene, tmp_path: Path) -> None:
    used, empty = tmp_path / "used", tmp_path / "empty"
    used.mkdir()
    empty.mkdir()
    export(scene, empty)
    assert {p.name for p in empty.iterdir()} == {"static", "dynamic_2views"}
    (used / "mine.txt").write_text("keep")
    with pytest.raises(DevrfError, match="used"):
        export(scene, used)
    assert [p.name for p in used.iterdir()] == ["mine.txt"]
    assert {p.name for p in tmp_path.iterdir()} == {"used", "empty"}


@pytest.fixture
def facing(tiny_toy: Scene) -> Scene:
    return tiny_toy


def views_of(scene: Scene) -> list[Views]:
    return [v for capture in (scene.static, scene.dynamic) for v in (capture.train, capture.test)]


def test_what_is_exported_reads_back_the_same(facing: Scene, tmp_path: Path) -> None:
    export(facing, tmp_path / "scene")
    again = LlffReader(tmp_path / "scene").read()
    for ours, read in zip(views_of(facing), views_of(again), strict=True):
        assert torch.equal(ours.pixels, read.pixels)
        assert torch.equal(ours.times, read.times) and torch.equal(ours.view, read.view)
        camera = torch.arange(len(ours)).repeat_interleave(24 * 18)
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


def test_frames_without_times_have_to_be_evenly_spread(facing: Scene, tmp_path: Path) -> None:
    train = facing.dynamic.train
    gap = replace(facing.dynamic, train=train[(train.times != 0.5).nonzero()[:, 0]])
    with pytest.raises(DevrfError, match="data.novel_times_every"):
        export(replace(facing, dynamic=gap), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_film_by_hand_reads_back_the_same(tmp_path: Path) -> None:
    recipe = ProceduralForwardScene(camera="handheld", frames=4, width=24, height=18, supersample=1)
    scene = recipe()
    export(scene, tmp_path / "film")
    assert len(list((tmp_path / "film" / "images").iterdir())) == 4  # what stage=capture takes
    back = NerfstudioReader(tmp_path / "film", downscale=1).read()
    assert back.kind == "forward" and back.static.train is back.dynamic.train
    for there, here in (
        (back.dynamic.train, scene.dynamic.train),
        (back.dynamic.test, scene.dynamic.test),
    ):
        assert torch.equal(there.pixels, here.pixels)
        torch.testing.assert_close(there.times, here.times)
        off = there.cameras.camera_to_world - here.cameras.camera_to_world
        # Readers take the average pose of the training views and the others as the identity.
        assert float(off.abs().max()) < 1e-4
    masks = back.dynamic.test.valid_mask
    assert masks is not None and torch.equal(masks, scene.dynamic.test.valid_mask)
    assert back.dynamic.train.valid_mask is None


def test_an_image_that_has_no_room_is_one_line(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    noise = torch.randint(0, 256, (32, 32, 3), generator=torch.Generator().manual_seed(0))
    try:
        with pytest.raises(OSError) as caught:
            write_image(tmp_path / "noise.png", noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert one_line(caught.value) == "a file that is written: File too large"

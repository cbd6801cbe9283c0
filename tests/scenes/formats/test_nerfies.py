"""Nerfies' layout: cameras by geometry, lenses, scaled worlds, splits, times, wrong input."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.cameras import Distortion
from devrf.scenes.formats.nerfies import NerfiesReader
from devrf.scenes.lens import Lens
from layouts import write_camera

# Not square, the principal point off the middle, and pixels that are neither.
WIDTH, HEIGHT, COUNT = 80, 60, 9
LENS = Lens((88.0, 88.0 * 0.95), (42.0, 28.0), Distortion((-0.3, 0.1, 0.01, 0), (6e-3, -8e-3)), 3.0)
CENTER, SCALE = torch.tensor([3.0, -2.0, 1.0]), 0.25
IDS = [f"{i:06d}" for i in range(COUNT)]


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, NerfiesReader, downscale=1)


class Folder:
    """A valid scene of nine images that a test then breaks in one place."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, name: str, content: Any) -> None:
        (self.root / name).write_text(json.dumps(content))

    def edit(self, name: str, change: Callable[[dict[str, Any]], object]) -> None:
        content = json.loads((self.root / name).read_text())
        change(content)
        self.write(name, content)


@pytest.fixture
def folder(tmp_path, ring_cameras, picture) -> Folder:
    """The scene of the balls, in a world that scene.json moves back to the origin."""
    made = Folder(tmp_path / "scene")
    ring = ring_cameras(COUNT, width=WIDTH, height=HEIGHT, angle=0.9)
    for item, pose in zip(IDS, ring.camera_to_world, strict=True):
        pixels = picture(pose, LENS, WIDTH, HEIGHT)
        placed = torch.cat([pose[:, :3], (pose[:, 3] / SCALE + CENTER)[:, None]], dim=1)
        write_camera(made.root, "1x", item, pixels, placed, LENS)
    made.write("scene.json", {"center": CENTER.tolist(), "scale": SCALE, "near": 0.5, "far": 9.0})
    made.write("metadata.json", {item: {"warp_id": 10 + i} for i, item in enumerate(IDS)})
    lists = {"train_ids": IDS[:3] + IDS[4:8], "val_ids": [IDS[3], IDS[8]]}
    made.write("dataset.json", {"count": COUNT, "ids": IDS, **lists})
    return made


def test_points_fall_on_the_pixels_that_show_them(folder, balls_are_where_they_project):
    half = NerfiesReader(folder.root, downscale=2).read().dynamic.train
    assert (half.width, half.height) == (WIDTH // 2, HEIGHT // 2)
    balls_are_where_they_project(half)
    scene = NerfiesReader(folder.root, downscale=1).read()
    assert scene.kind == "inward" and scene.name == "scene"
    for views in (scene.dynamic.train, scene.dynamic.test, scene.static.train, scene.static.test):
        balls_are_where_they_project(views)
    # The ring's own distance: positions were moved and scaled back.
    distance = scene.dynamic.train.cameras.positions.norm(dim=1)
    torch.testing.assert_close(distance, torch.full((7,), 4.0))
    assert (scene.bounds.near, scene.bounds.far) == (0.5, 9.0)


def test_positions_far_from_the_center_keep_their_digits(folder):
    near = NerfiesReader(folder.root, downscale=1, space="world").read()
    for item in IDS:
        folder.edit(
            f"camera/{item}.json",
            lambda c: c.update(position=[p + 4e6 for p in c["position"]]),
        )
    for item in IDS:  # opaque: the box is all that cameras see up to far
        image = iio.imread(folder.root / f"rgb/1x/{item}.png")
        iio.imwrite(folder.root / f"rgb/1x/{item}.png", image[..., :3])
    far = NerfiesReader(folder.root, downscale=1, space="world").read()
    assert far.offset == (1e6, 1e6, 1e6)  # of a world a quarter as large
    positions = near.dynamic.train.cameras.positions
    torch.testing.assert_close(far.dynamic.train.cameras.positions, positions, rtol=0, atol=1e-5)
    assert far.bounds.box.contains(torch.zeros(3)) and far.bounds.box.longest < 40
    folder.edit("scene.json", lambda c: c.update(center=[p + 4e6 for p in c["center"]]))
    assert NerfiesReader(folder.root, downscale=1).read().offset == (0, 0, 0)


def test_splits_times_and_the_stand_in_for_a_static_set(folder, caplog):
    with caplog.at_level(logging.WARNING):
        scene = NerfiesReader(folder.root, downscale=1, static_until=0.3).read()
    assert "no static set: the canonical field is learned from 3 of the 7" in caplog.text
    train = scene.dynamic.train
    assert scene.dynamic.test.names == ("rgb/1x/000003.png", "rgb/1x/000008.png")
    torch.testing.assert_close(train.times, torch.tensor([0, 1, 2, 4, 5, 6, 7]) / 8)
    torch.testing.assert_close(scene.dynamic.test.times, torch.tensor([3, 8]) / 8)
    assert train.view.tolist() == list(range(7)) and len(scene.static.train) == 3
    assert len(NerfiesReader(folder.root, downscale=1, frames=3).read().dynamic.train) == 3


def test_without_alpha_masks_the_box_holds_the_backdrop(folder):
    folder.edit("scene.json", lambda c: c.update(far=6.0))
    cut_out = NerfiesReader(folder.root, downscale=1).read().bounds.box
    for item in IDS:
        image = iio.imread(folder.root / f"rgb/1x/{item}.png")
        iio.imwrite(folder.root / f"rgb/1x/{item}.png", image[..., :3])
    unbounded = NerfiesReader(folder.root, downscale=1).read()
    assert not unbounded.space.is_linear
    assert unbounded.bounds.reason.startswith("the images have no")
    with pytest.raises(DevrfError, match="data.far: the scene is unbounded .*data.space=world"):
        NerfiesReader(folder.root, downscale=1, far=5.0).read()
    scene = NerfiesReader(folder.root, downscale=1, space="world").read()
    cameras, box = scene.static.train.cameras, scene.bounds.box
    for camera in range(len(cameras)):
        rays = cameras.image_rays(camera)
        for distance in (0.5, 3.0, 6.0):
            assert box.scaled(1.001).contains(rays.origins + distance * rays.directions).all()
    assert box.volume > cut_out.volume


def test_time_ids_come_before_warp_ids(folder):
    def backwards(content: dict[str, Any]) -> None:
        for i, item in enumerate(IDS):
            content[item]["time_id"] = 8 - i

    folder.edit("metadata.json", backwards)
    assert NerfiesReader(folder.root, downscale=1).read().dynamic.train.times[0] == 1


def test_what_is_held_out_is_not_learned_from(folder, caplog):
    folder.edit("dataset.json", lambda c: c.update(train_ids=IDS, val_ids=IDS[2:4]))
    with caplog.at_level(logging.WARNING):
        scene = NerfiesReader(folder.root, downscale=1).read()
    assert "2 images of val_ids are in train_ids too" in caplog.text
    assert not set(scene.dynamic.train.names) & set(scene.dynamic.test.names)
    folder.write("dataset.json", {"train_ids": IDS[:2], "val_ids": IDS[2:4]})
    assert len(NerfiesReader(folder.root, downscale=1).read().dynamic.train) == 2


def test_long_lists_of_absent_images_are_gone_through_once(folder, message_of):
    train, val = ([f"{part}{k}" for k in range(12_000)] for part in "ab")
    folder.write("dataset.json", {"train_ids": train, "val_ids": val})
    began = time.process_time()
    assert "24000 of the 24000 images" in message_of(folder.root)
    assert time.process_time() - began < 6
    folder.write("dataset.json", {"ids": [str(k) for k in range(50_001)]})
    assert "ids: expected at most 50000 items" in message_of(folder.root)


def test_times_that_are_wrong_are_counted_first(folder, message_of):
    """Of a million and a half, the errors took 2 GiB."""
    folder.write("metadata.json", dict.fromkeys(map(str, range(50_001)), 0))
    assert "expected at most 50000 images, not 50001; correct it" in message_of(folder.root)


CAMERA = "camera/000004.json"


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("metadata.json", lambda c: c[IDS[5]].pop("warp_id"), "image '000005' has no warp_id"),
        (
            "metadata.json",
            lambda c: c.update(dict.fromkeys(map(str, range(50_001)), {})),
            "at most",
        ),
        ("scene.json", lambda c: c.pop("near"), "near: is missing"),
        (CAMERA, lambda c: c.update(focal_length=0), "focal_length: expected more than 0"),
        (CAMERA, lambda c: c.update(orientation=[[1, 0, 0]] * 3), "orientation or position"),
    ],
)
def test_wrong_values(folder, file, change, said, message_of):
    folder.edit(file, change)
    message = message_of(folder.root)
    assert said in message and Path(file).stem in message

"""Dynamic 3D Gaussians' lists of a dome's cameras: times, the static set, masks, and refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.scenes.formats.panoptic import PanopticReader
from devrf.scenes.lens import Lens
from layouts import opencv_matrices, put_json

WIDTH, HEIGHT, CAMERAS, TIMES = 40, 32, 5, 3
FOCAL, CENTER = (44.0, 42.0), (21.0, 15.0)


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, PanopticReader, downscale=1)


@pytest.fixture
def folder(tmp_path, ring_cameras, picture) -> Path:
    """The balls, seen by five cameras that stand; the last one is held out."""
    root = tmp_path / "juggle"
    cameras = ring_cameras(CAMERAS, width=WIDTH, height=HEIGHT, angle=0.9)
    to_camera, k = opencv_matrices(cameras)
    k[:, [0, 1], [0, 1]] = FOCAL
    k[:, :2, 2] = CENTER
    for split, numbers in (("train", range(CAMERAS - 1)), ("test", [CAMERAS - 1])):
        names = [[f"{camera}/{time:06d}.png" for camera in numbers] for time in range(TIMES)]
        for taken in names:
            for camera, name in zip(numbers, taken, strict=True):
                pose = cameras.camera_to_world[camera]
                pixels = picture(pose, Lens(FOCAL, CENTER), WIDTH, HEIGHT)
                # A row of the dome's wall, which no mask has.
                pixels[0] = 255
                mask = pixels[..., 3].copy()
                mask[0] = 0
                for part, image in (("ims", pixels[..., :3]), ("seg", mask)):
                    (root / part / name).parent.mkdir(parents=True, exist_ok=True)
                    iio.imwrite(root / part / name, image)
        listed = {"w": WIDTH, "h": HEIGHT, "fn": names, "cam_id": [[*numbers]] * TIMES}
        listed["k"] = [[k[camera].tolist() for camera in numbers]] * TIMES
        listed["w2c"] = [[to_camera[camera].tolist() for camera in numbers]] * TIMES
        put_json(root / f"{split}_meta.json", listed)
    return root


def test_the_first_images_are_the_static_set(folder):
    scene = PanopticReader(folder, downscale=1).read()
    train, test = scene.dynamic.train, scene.dynamic.test
    assert (len(train), len(test)) == (12, 3) and len(scene.static.train) == 4
    assert train.times.tolist() == [0.0] * 4 + [0.5] * 4 + [1.0] * 4
    assert train.view.tolist() == [0, 1, 2, 3] * 3 and not train.by_moving_camera
    assert [Path(name).parent.name for name in test.names] == ["4"] * 3
    assert [Path(name).stem for name in scene.static.test.names] == ["000000"]
    few = PanopticReader(folder, downscale=1, train_views=2, frames=2).read().dynamic.train
    assert few.view.tolist() == [0, 1] * 2 and few.times.tolist() == [0.0, 0.0, 1.0, 1.0]


def test_so_are_those_of_two_cameras(folder):
    listed = json.loads((folder / "train_meta.json").read_text())
    listed |= {key: [taken[:2] for taken in listed[key]] for key in ("fn", "k", "w2c", "cam_id")}
    put_json(folder / "train_meta.json", listed)
    scene = PanopticReader(folder, downscale=1).read()
    assert scene.static.train.times.tolist() == [0.0, 0.0] and len(scene.dynamic.train) == 6


def test_masks_cut_the_subject_out(folder, balls_are_where_they_project):
    scene = PanopticReader(folder, downscale=1, masks="alpha").read()
    for views in (scene.dynamic.train, scene.dynamic.test, scene.static.train):
        balls_are_where_they_project(views)
        assert not bool(views.pixels[:, 0, :, 3].any())
    assert scene.space.is_linear
    assert not PanopticReader(folder, downscale=1).read().space.is_linear
    for file in (folder / "seg").rglob("*.png"):  # as they are published
        iio.imwrite(file, (iio.imread(file) > 127).astype(np.uint8))
    labels = PanopticReader(folder, downscale=1, masks="alpha").read().dynamic.train
    assert torch.equal(labels.pixels[..., 3] > 0, scene.dynamic.train.pixels[..., 3] > 127)


def test_what_is_refused(folder, message_of):
    file = folder / "train_meta.json"
    whole = json.loads(file.read_text())

    def refused(**changed) -> str:
        put_json(file, whole | changed)
        return message_of(folder)

    fewer = {key: whole[key][:2] for key in ("fn", "k", "w2c")}
    assert "test_meta.json: lists 3 times, and train_meta.json 2; list all" in refused(**fewer)
    turned = [[torch.ones(4, 4).tolist()] * 4] * 3
    assert "w2c" in refused(w2c=[]) and "0/000000.png" in refused(w2c=turned)
    assert "fn, k and w2c do not list as many images" in refused(k=whole["k"][:2])
    many = {key: [[whole[key][0][0]] * 16_667] * 3 for key in ("fn", "k", "w2c")}
    assert "lists more than 50000 images" in refused(**many)
    assert "no such image" in refused(fn=[["9/000000.png"] * 4, *whole["fn"][1:]])
    assert "leads outside" in refused(fn=[["../../x.png"] * 4, *whole["fn"][1:]])

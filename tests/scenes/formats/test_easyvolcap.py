"""EasyVolcap's files: cameras by OpenCV, a folder of images each, masks, and refusals."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.geometry.cameras import Distortion
from devrf.scenes.formats.easyvolcap import EasyVolcapReader
from devrf.scenes.lens import Lens
from layouts import opencv_matrices

WIDTH, HEIGHT, CAMERAS, TIMES = 40, 32, 5, 3
LENS = Lens((44.0, 42.0), (21.0, 15.0), Distortion((-0.08, 0.01, 0.0, 0.0), (0.002, -0.001)))


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, EasyVolcapReader, downscale=1)


@pytest.fixture
def folder(tmp_path, ring_cameras, picture) -> Path:
    """The balls, seen through lenses with distortion by five cameras that stand."""
    root = tmp_path / "actor"
    cameras = ring_cameras(CAMERAS, width=WIDTH, height=HEIGHT, angle=0.9)
    to_camera, _ = opencv_matrices(cameras)
    root.mkdir()
    files = [
        cv2.FileStorage(str(root / f"{part}.yml"), cv2.FILE_STORAGE_WRITE)
        for part in ("intri", "extri")
    ]
    names = [f"{camera:02d}" for camera in range(CAMERAS)]
    for file in files:
        file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            file.write("", name)
        file.endWriteStruct()
    (fx, fy), (cx, cy) = LENS.focal, LENS.center
    for camera, name in enumerate(names):
        files[0].write(f"K_{name}", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        files[0].write(f"D_{name}", np.array([[-0.08, 0.01, 0.002, -0.001, 0.0]]))
        # Only some files have the matrix beside the vector.
        files[1].write(f"R_{name}", cv2.Rodrigues(to_camera[camera, :3, :3])[0])
        if camera % 2:
            files[1].write(f"Rot_{name}", to_camera[camera, :3, :3])
        files[1].write(f"T_{name}", to_camera[camera, :3, 3:])
        pixels = picture(cameras.camera_to_world[camera], LENS, WIDTH, HEIGHT)
        for part, image in (("images", pixels[..., :3]), ("masks", pixels[..., 3])):
            (root / part / name).mkdir(parents=True)
            for time in range(TIMES):
                iio.imwrite(root / part / name / f"{time:06d}.png", image)
    for file in files:
        file.release()
    return root


def test_cameras_lenses_and_masks(folder, balls_are_where_they_project):
    scene = EasyVolcapReader(folder, downscale=1).read()
    train, test = scene.dynamic.train, scene.dynamic.test
    for views in (train, test, scene.static.train):
        balls_are_where_they_project(views)
    assert train.times.tolist() == [0.0] * 4 + [0.5] * 4 + [1.0] * 4
    assert train.view.tolist() == [0, 1, 2, 3] * 3 and len(scene.static.train) == 4
    assert {Path(name).parent.name for name in test.names} == {"04"}
    torch.testing.assert_close(train.cameras.positions.norm(dim=1), torch.full((12,), 4.0))
    second = EasyVolcapReader(folder, downscale=1, test_view=2).read().dynamic.test
    assert {Path(name).parent.name for name in second.names} == {"01"}
    assert not EasyVolcapReader(folder, downscale=1, masks="none").read().space.is_linear


def test_the_first_images_of_two_cameras_are_the_static_set(folder):
    for file in (folder / "intri.yml", folder / "extri.yml"):
        lines = file.read_text().splitlines()
        others = [f'- "{camera:02d}"' for camera in range(3, CAMERAS)]
        file.write_text("\n".join(line for line in lines if line.strip() not in others))
    scene = EasyVolcapReader(folder, downscale=1).read()
    assert scene.static.train.times.tolist() == [0.0, 0.0] and len(scene.dynamic.train) == 6


def test_a_camera_that_began_later_than_the_others_is_warned_of(folder, caplog):
    """As many images as the others, each of them a moment late."""
    images = folder / "images" / "02"
    for time in reversed(range(TIMES)):
        (images / f"{time:06d}.png").rename(images / f"{time + 1:06d}.png")
    EasyVolcapReader(folder, downscale=1, masks="none").read()
    first = folder / "images/00/000000.png"
    said = f"{images}/000001.png is taken to show the moment of {first}, by its place"
    assert caplog.messages.count(said) == 1


def test_what_is_refused(folder, message_of):
    file = folder / "intri.yml"
    whole = file.read_text()

    def refused(old: str, new: str) -> str:
        file.write_text(whole.replace(old, new))
        return message_of(folder)

    assert "K_03: expected 9 finite numbers" in refused("K_03", "K_30")
    assert "'../00' is no folder's name" in refused('"00"', '"../00"')
    assert "H_00: expected 1 finite" in refused("K_00", "H_00: .Nan\nK_00")
    assert "not a readable YAML file of OpenCV" in refused("data: [", "data: ]")
    deep = f"deep: {'[' * 20_000}{']' * 20_000}\nnames:"  # OpenCV ends the program at this
    assert "not a readable YAML file of OpenCV" in refused("names:", deep)
    assert "a large number is no folder's" in refused("names:", f"names: 0x{'f' * 6000}\nrest:")
    assert "an alias" in refused("names:", "one: &one [1]\nmany: [*one, *one]\nnames:")
    file.write_text(whole)
    (folder / "images" / "02" / "000001.png").unlink()
    assert f"02: has 2 images, but {folder}/images/00 has 3" in message_of(folder)
    assert "extri.yml: no such file" in message_of(_without(folder, "extri.yml"))


def _without(folder: Path, name: str) -> Path:
    (folder / name).unlink()
    return folder

"""Wrong forward-facing input: one line that names the file, what was expected, what to do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from devrf.scenes.formats.llff import LlffReader

STATIC = "static/poses_bounds.npy"
POSES = "dynamic_3views/poses.npy"
BOUNDS = "dynamic_3views/bds.npy"


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, LlffReader)


def stored(folder: Any, file: str) -> np.ndarray:
    values: np.ndarray = np.load(folder.root / file)
    return values


@pytest.mark.parametrize(
    ("file", "where", "value", "said"),
    [
        (STATIC, (2, 3), np.nan, "NaN or infinity"),
        (STATIC, (2, 3), np.inf, "NaN or infinity"),
        (STATIC, (2, 14), 0, "camera 2: the focal length is not above 0"),
        (STATIC, (2, 14), -80, "camera 2: the focal length is not above 0"),
        (STATIC, (3, 4), 0, "camera 3: height or width"),
        (STATIC, (3, 4), 640, "another shape"),
        (STATIC, (1, 0), 1, "camera 1: its axes are no rotation"),
        (STATIC, (0, 15), 0, "camera 0: expected 0 < least depth < largest depth"),
        (STATIC, (0, 15), 60, "camera 0: expected 0 < least depth < largest depth"),
        (POSES, (4, 1, 1), -1, "camera 4: its axes are no rotation"),
        (POSES, (4, 2, 4), 0, "camera 4: the focal length"),
        (POSES, (4, 0, 3), np.nan, "NaN or infinity"),
        (BOUNDS, (1, 0), -1, "camera 1: expected 0 < least depth"),
    ],
)
def test_wrong_numbers(llff_folder, file, where, value, said, message_of):
    values = stored(llff_folder, file)
    values[where] = value
    path = llff_folder.save(file, values)
    message = message_of(llff_folder.root)
    assert str(path) in message and said in message


@pytest.mark.parametrize("file", [STATIC, POSES, BOUNDS])
@pytest.mark.parametrize("keep", [0, 5, 100, 200])
def test_truncated_arrays(llff_folder, file, keep, message_of):
    path = llff_folder.root / file
    path.write_bytes(path.read_bytes()[:keep])
    assert f"{path}: not a readable npy file" in message_of(llff_folder.root)


@pytest.mark.parametrize("file", [STATIC, POSES, BOUNDS])
def test_arrays_of_something_else(llff_folder, file, message_of):
    path = llff_folder.save(file, np.array(["a", "b"]))
    assert f"{path}: holds values of type" in message_of(llff_folder.root)
    llff_folder.save(file, np.array([{"a": 1}], dtype=object))
    assert f"{path}: not a readable npy file" in message_of(llff_folder.root)
    for shape in ((), (4,), (4, 7), (0, 17), (0, 3, 5), (3, 17, 1)):
        llff_folder.save(file, np.ones(shape))
        message = message_of(llff_folder.root)
        assert f"{path}: has shape" in message and "expected" in message
    with path.open("wb") as archive:
        np.savez(archive, poses=np.ones(3))
    assert f"{path}: not a readable npy file" in message_of(llff_folder.root)


@pytest.mark.parametrize("file", [STATIC, POSES, BOUNDS])
def test_missing_files(llff_folder, file, message_of):
    (llff_folder.root / file).unlink()
    assert f"{llff_folder.root / file}: no such file" in message_of(llff_folder.root)


def test_poses_without_intrinsics(llff_folder, message_of):
    rows = stored(llff_folder, STATIC)
    llff_folder.save(STATIC, np.delete(rows, [4, 9, 14], axis=1))
    path = llff_folder.static / "hwf_cxcy.npy"
    assert f"{path}: no such file" in message_of(llff_folder.root)
    for values, said in (
        (np.ones(4), "holds 4 numbers"),
        (np.array([64, 96, 0, 48, 32.0]), "the focal length"),
        (np.array([64, 96, np.nan, 48, 32.0]), "NaN"),
        (np.array([96, 64, 80, 48, 32.0]), "another shape"),
    ):
        np.save(path, values)
        message = message_of(llff_folder.root)
        assert said in message and "static" in message


def test_counts_that_do_not_match(llff_folder, message_of):
    rows, poses = stored(llff_folder, STATIC), stored(llff_folder, POSES)
    path = llff_folder.save(STATIC, rows[:8])
    assert f"{path}: has 8 cameras, but" in message_of(llff_folder.root)
    llff_folder.save(STATIC, rows)
    path = llff_folder.save(BOUNDS, np.tile([1.0, 2.0], (4, 1)))
    assert f"{path}: has shape (4, 2), expected (5, 2)" in message_of(llff_folder.root)
    llff_folder.save(BOUNDS, np.tile([1.0, 2.0], (2, 1)))
    path = llff_folder.save(POSES, poses[:2])
    assert f"{path}: has 2 cameras, but there are 3 folders" in message_of(llff_folder.root)


def test_missing_folders(llff_folder, tmp_path, message_of):
    root = llff_folder.root
    assert "nowhere: no such folder" in message_of(tmp_path / "nowhere")
    (llff_folder.dynamic / "view1").rename(llff_folder.dynamic / "view0")
    assert f"{llff_folder.dynamic}/view0: views are numbered view1, view2" in message_of(root)
    (llff_folder.dynamic / "view0").rename(llff_folder.dynamic / "view1")
    (llff_folder.dynamic / "view2").rename(llff_folder.dynamic / "other")
    assert f"{llff_folder.dynamic}: no folder view2 although there is view3" in message_of(root)
    for view in ("view1", "view3"):
        shutil.rmtree(llff_folder.dynamic / view)
    assert f"{llff_folder.dynamic}: no folders view1" in message_of(root)
    shutil.rmtree(llff_folder.dynamic)
    message = message_of(root, dynamic="dynamic_3views")
    assert f"{root}: no folder 'dynamic_3views' (found: none)" in message
    shutil.rmtree(llff_folder.static)
    assert f"{llff_folder.static}: no such folder" in message_of(root)


def test_missing_images(llff_folder, message_of):
    message = message_of(llff_folder.root, downscale=2)
    assert "no folder images_2 or images (found: images_4)" in message
    assert "no folder images (found: images_4)" in message_of(llff_folder.root, downscale=1)
    images = llff_folder.dynamic / "view2" / "images_4"
    (images / "002.png").unlink()
    assert f"{images}: has 2 images, but" in message_of(llff_folder.root)
    shutil.rmtree(images)
    images.mkdir()
    assert f"{images}: no images" in message_of(llff_folder.root)
    shutil.rmtree(images)
    assert f"{images.parent}: no folder images_4 or images" in message_of(llff_folder.root)


def test_views_at_different_sizes(llff_folder, message_of):
    view = llff_folder.dynamic / "view2"
    shutil.rmtree(view / "images_4")
    llff_folder.images(view / "images", 3, times=4)
    assert f"{view}: no folder images_4" in message_of(llff_folder.root)


def test_one_image_is_no_capture(llff_folder, message_of):
    for view in (1, 2, 3):
        for frame in ("001", "002"):
            (llff_folder.dynamic / f"view{view}" / "images_4" / f"{frame}.png").unlink()
    assert "at least 2 frames" in message_of(llff_folder.root)
    llff_folder.save(STATIC, stored(llff_folder, STATIC)[:1])
    for path in sorted((llff_folder.static / "images_4").iterdir())[1:]:
        path.unlink()
    assert "holds one image" in message_of(llff_folder.root)


@pytest.mark.parametrize(
    "file", ["static/images_4/004.png", "dynamic_3views/view2/images_4/001.png"]
)
def test_a_damaged_image(llff_folder, file, message_of):
    path = llff_folder.root / file
    path.write_bytes(path.read_bytes()[:30])
    assert f"{path}: not a readable image" in message_of(llff_folder.root)


def test_flow_of_another_size(llff_folder, message_of):
    llff_folder.HEIGHT, llff_folder.WIDTH = 24, 16
    llff_folder.flow(1, "001", 1.0)
    message = message_of(llff_folder.root)
    assert "001_bwd.npz" in message and "(16, 24, 2)" in message


def test_cameras_around_a_scene_are_not_forward_facing(llff_folder, message_of):
    rows = stored(llff_folder, STATIC)
    matrix = rows[:, :15].reshape(9, 3, 5)
    for k in range(9):
        angle = 2 * np.pi * k / 9
        c, s = np.cos(angle), np.sin(angle)
        matrix[k, :, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ matrix[k, :, :3]
    path = llff_folder.save(STATIC, np.concatenate([matrix.reshape(9, 15), rows[:, 15:]], axis=1))
    message = message_of(llff_folder.root)
    assert str(path) in message and "data=inward" in message


@pytest.mark.parametrize("camera", [2, 4])
def test_a_fixed_camera_that_looks_elsewhere(llff_folder, camera, message_of):
    poses = stored(llff_folder, POSES)
    # A quarter turn about the vertical axis: right is back, back is left.
    poses[camera, :, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    llff_folder.save(POSES, poses)
    message = message_of(llff_folder.root)
    assert f"view{camera - 1}/images_4/000.png: its camera does not look along" in message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"downscale": 12}, "8x5 px"),
        ({"holdout": 1}, "data.holdout"),
        ({"train_views": 0}, "data.train_views"),
        ({"train_views": 3}, "there are 2 views to learn from"),
        ({"test_view": 0}, "data.test_view"),
        ({"test_view": 4}, "none of the 3 views in"),
        ({"test_view": 4}, "view1 … view3; give 1 … 3"),
        ({"test_view": -4}, "none of the 3 views"),
        ({"test_view": 1.0}, "data.test_view"),
        ({"near": 0}, "data.near"),
        ({"near": float("nan")}, "data.near"),
        ({"dynamic": "other"}, "'other'"),
    ],
)
def test_wrong_options(llff_folder, options, said, message_of):
    assert said in message_of(llff_folder.root, **options)

"""Forward-facing scenes on disk: what is read, in which frame, with which numbers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.formats.llff import LlffReader
from devrf.scenes.formats.llff_poses import PosedSet
from devrf.scenes.lens import Intrinsics
from devrf.scenes.scene import Views


def reds(views: Views) -> list[int]:
    """The number that each image carries."""
    return views.pixels[:, 0, 0, 0].tolist()


def test_the_published_layout(llff_folder):
    scene = LlffReader(llff_folder.root).read()
    assert (scene.name, scene.kind, scene.background) == ("toy", "forward", "white")
    assert scene.static.train.pixels.shape == (7, 16, 24, 3)
    # Every eighth image is held out: 0 and 8.
    assert reds(scene.static.train) == [1, 2, 3, 4, 5, 6, 7]
    assert reds(scene.static.test) == [0, 8]
    assert scene.static.train.times.tolist() == [0] * 7
    assert scene.static.train.view.tolist() == list(range(7))
    assert scene.static.test.names == ("static/images_4/000.png", "static/images_4/008.png")
    train, test = scene.dynamic.train, scene.dynamic.test
    assert reds(train) == [0, 10, 1, 11, 2, 12] and reds(test) == [20, 21, 22]
    assert train.view.tolist() == [0, 1] * 3 and test.view.tolist() == [0] * 3
    assert train.times.tolist() == [0, 0, 0.5, 0.5, 1, 1]
    assert test.times.tolist() == [0, 0.5, 1]
    assert train.names[3] == "dynamic_3views/view2/images_4/001.png"
    assert train.flow is None and scene.clock.times == (0.0, 0.5, 1.0)


def test_static_poses_by_hand(llff_folder):
    cameras = LlffReader(llff_folder.root).read().static.train.cameras
    # 4.5 world units apart are one unit of 0.75 · 6; the middle one of nine is the origin. What
    # was [down, right, back] along (−z, y, x) is right, up, back along (x, y, z) when centred.
    expected = torch.eye(3, 4).repeat(7, 1, 1)
    expected[:, 0, 3] = torch.arange(1, 8) - 4.0
    torch.testing.assert_close(cameras.camera_to_world, expected)
    # A focal length of 80 px in images of 96×64 is 20 px in these of 24×16.
    assert cameras.focal.tolist() == [[20, 20]] * 7
    assert cameras.center.tolist() == [[12, 8]] * 7
    assert (cameras.width, cameras.height) == (24, 16)


def test_a_world_point_falls_on_the_pixel_computed_by_hand(llff_folder):
    scene = LlffReader(llff_folder.root).read()
    # The world point 9 before the middle camera (at y = 20 + 4 · 4.5), 1.8 right, 0.9 up of it:
    # (0.4, 0.2, −2) in the reader's frame.
    point = torch.tensor([[0.4, 0.2, -2.0]])
    pixel, depth = scene.static.train.cameras.project(torch.tensor([3]), point)
    assert pixel[0].tolist() == pytest.approx([12 + 20 * 0.2, 8 - 20 * 0.1])
    assert float(depth) == 2
    # The fixed view 2 is at the origin too, view 1 half a unit to its left.
    assert scene.dynamic.test.cameras.positions[0].tolist() == [0.5, 0, 0]
    pixel, _ = scene.dynamic.train.cameras.project(torch.tensor([0, 1]), point.repeat(2, 1))
    assert pixel[0].tolist() == pytest.approx([12 + 20 * 0.45, 6])
    assert pixel[1].tolist() == pytest.approx([16, 6])


@pytest.mark.parametrize(
    ("names", "found"),
    [
        # By the images' names, by the numbers in them, by position.
        (("a_010.png", "a_020.png", "a_030.png"), {"a_020": 1, "a_030": 2}),
        (("a_010.png", "a_020.png", "a_030.png"), {"001": 1, "002": 2}),
        # Time passes by numbers, not by letters.
        (("8.png", "9.png", "10.png"), {"9": 1, "10": 2}),
    ],
)
def test_flow_finds_its_frame(llff_folder, names, found):
    for view in (1, 2, 3):
        folder = llff_folder.dynamic / f"view{view}" / "images_4"
        for k, name in enumerate(names):
            (folder / f"{k:03d}.png").rename(folder / f"moving_{name}")
        for name in names:
            (folder / f"moving_{name}").rename(folder / name)
        for name, frame in found.items():
            llff_folder.flow(view, name, 10 * view + frame)
    train = LlffReader(llff_folder.root).read().dynamic.train
    assert reds(train) == [0, 10, 1, 11, 2, 12]
    assert train.flow is not None
    assert train.flow.vectors[:, 3, 5, 0].tolist() == [0, 0, 11, 21, 12, 22]
    assert train.flow.vectors[:, 3, 5, 1].tolist() == [0, 0, -11, -21, -12, -22]
    assert train.flow.valid.flatten(1).any(dim=1).tolist() == [False] * 2 + [True] * 4


def test_forward_flow_leaves_out_the_last_frame(llff_folder):
    for name, value in (("000", 1.0), ("001", 2.0), ("002", 9.0)):
        llff_folder.flow(1, name, value, "fwd")
    reader = LlffReader(llff_folder.root)
    train = reader.read().dynamic.train
    assert train.flow is None and train.forward_flow is None
    found = reader.forward_flow(train)
    assert found is not None
    assert found.vectors[:, 3, 5, 0].tolist() == [1, 0, 2, 0, 0, 0]
    assert found.valid.flatten(1).any(dim=1).tolist() == [True, False, True, False, False, False]
    # Frames that are left out have no neighbours.
    thinned = LlffReader(llff_folder.root, frames=2)
    assert thinned.forward_flow(thinned.read().dynamic.train) is None


@pytest.mark.parametrize(("test_view", "held_out"), [(2, 10), (-3, 0)])
def test_another_view_is_held_out(llff_folder, test_view, held_out, caplog):
    llff_folder.flow(3, "001", 3.0)
    dynamic = LlffReader(llff_folder.root, test_view=test_view).read().dynamic
    assert "3 of 4 flow files are missing" in caplog.text
    assert reds(dynamic.test) == [held_out, held_out + 1, held_out + 2]
    assert set(reds(dynamic.train)) == {0, 1, 2, 10, 11, 12, 20, 21, 22} - set(reds(dynamic.test))
    assert dynamic.train.view.tolist() == [0, 1] * 3
    # Cameras and flow stay with their own views.
    place = {0: -0.5, 1: 0.0, 2: 0.5}
    for red, camera in zip(reds(dynamic.train), dynamic.train.cameras.positions, strict=True):
        assert float(camera[0]) == place[red // 10]
    assert dynamic.train.flow is not None
    valid = dynamic.train.flow.valid.flatten(1).any(dim=1)
    assert [r for r, v in zip(reds(dynamic.train), valid, strict=True) if v] == [21]


def test_space_and_box_by_hand(llff_folder):
    scene = LlffReader(llff_folder.root).read()
    assert scene.space == NormalizedDevice(24, 16, (20.0, 20.0), 1.0)
    bounds = scene.bounds
    # All cameras look straight ahead: at infinity they see [−1, 1]; on the near plane a camera
    # moved by 3 sees as far as 1 + 3 · 20 / 12.
    assert bounds.box.low == pytest.approx((-6.0, -1.0, -1.0))
    assert bounds.box.high == pytest.approx((6.0, 1.0, 1.0))
    assert (bounds.near, bounds.far, bounds.motion, bounds.scale) == (0.0, 1.0, None, 1.0)
    assert LlffReader(llff_folder.root, near=0.5).read().bounds.box.high[0] == pytest.approx(11.0)


def test_a_stray_point_does_not_set_the_near_plane(llff_folder, caplog):
    caplog.set_level("INFO")
    expected = LlffReader(llff_folder.static).read().static.train.cameras.positions
    rows = llff_folder.static_rows()
    rows[[4, 7], 15] = 0.02, 2.9  # the others are 6 and 7: half of their median is 3.5
    llff_folder.save(STATIC, rows)
    cameras = LlffReader(llff_folder.static).read().static.train.cameras
    torch.testing.assert_close(cameras.positions, expected)
    assert "2 cameras see stray points before them: the nearest depth is 6, not 0.02" in caplog.text


def test_beside_fixed_views_a_stray_point_sets_the_unit_as_in_their_file(llff_folder, caplog):
    caplog.set_level("INFO")
    before = LlffReader(llff_folder.root).read()
    rows = llff_folder.static_rows()
    rows[4, 15] = 2.7  # the least depth of the others is 6: LLFF's own unit is 0.75 · 2.7
    llff_folder.save(STATIC, rows)
    for file in (POSES, BOUNDS):  # without the static cameras, which would tell their unit
        llff_folder.save(file, stored(llff_folder, file)[-3:])
    scene = LlffReader(llff_folder.root).read()
    static, moving = (capture.train.cameras for capture in (scene.static, scene.dynamic))
    torch.testing.assert_close(static.positions, before.static.train.cameras.positions * (6 / 2.7))
    # What is in LLFF's unit already is taken as it is.
    torch.testing.assert_close(moving.positions, before.dynamic.train.cameras.positions)
    assert "stray" not in caplog.text


def in_raw_world(folder: Any, count: int, views: int = 3) -> np.ndarray:
    """Rows of poses.npy in the world of poses_bounds.npy: ``count`` static cameras, then views."""
    poses = np.zeros((count + views, 3, 5))
    # The same axes for all: right, up, back along world y, z, x; the middle camera is at y = 38.
    poses[:, :, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    places = [*range(-4, count - 4), -0.5, 0, 0.5]
    poses[:, :, 3] = [[10, 38 + 4.5 * x, 30] for x in places]
    poses[:, :, 4] = stored(folder, POSES)[0, :, 4]
    folder.save(BOUNDS, np.tile([1.2, 9.0], (len(poses), 1)))
    return poses


@pytest.mark.parametrize("count", [1, 2, 9])
def test_fixed_views_in_the_world_of_the_static_cameras(llff_folder, count):
    expected = LlffReader(llff_folder.root).read().dynamic.train.cameras
    poses = in_raw_world(llff_folder, count)
    # The static ones in any order.
    llff_folder.save(POSES, np.concatenate([poses[:count][::-1], poses[count:]]))
    cameras = LlffReader(llff_folder.root).read().dynamic.train.cameras
    torch.testing.assert_close(cameras.camera_to_world, expected.camera_to_world)


@pytest.mark.parametrize("count", [2, 9])
def test_fixed_views_in_another_world_that_the_static_cameras_tell(llff_folder, count):
    expected = LlffReader(llff_folder.root).read().dynamic.train.cameras
    poses = in_raw_world(llff_folder, count)
    cosine, sine = np.cos(2), np.sin(2)
    poses[:, :, :4] = (
        np.array([[cosine, sine, 0], [0, 0, -1], [-sine, cosine, 0]]) @ poses[:, :, :4]
    )
    poses[:, :, 3] = 300 * poses[:, :, 3] + [5, -7, 11]
    llff_folder.save(POSES, poses)
    cameras = LlffReader(llff_folder.root).read().dynamic.train.cameras
    torch.testing.assert_close(cameras.camera_to_world, expected.camera_to_world)


def test_rows_before_the_fixed_views_that_are_no_static_cameras(llff_folder, caplog):
    expected = LlffReader(llff_folder.root).read().dynamic.train.cameras
    poses = stored(llff_folder, POSES)
    poses[1, 2, 3] += 20
    llff_folder.save(POSES, poses)
    cameras = LlffReader(llff_folder.root).read().dynamic.train.cameras
    assert torch.equal(cameras.camera_to_world, expected.camera_to_world)
    assert "its first 2 cameras are not those of poses_bounds.npy" in caplog.text


def test_without_such_rows_fixed_views_are_in_llffs_normalised_world(llff_folder):
    expected = LlffReader(llff_folder.root).read().dynamic.train.cameras
    llff_folder.save(POSES, stored(llff_folder, POSES)[-3:])
    llff_folder.save(BOUNDS, stored(llff_folder, BOUNDS)[-3:])
    cameras = LlffReader(llff_folder.root).read().dynamic.train.cameras
    assert torch.equal(cameras.camera_to_world, expected.camera_to_world)


def test_the_cameras_that_nr_nerf_publishes(llff_folder):
    """The same cameras as LLFF's, in axes right, up, back, without its file."""
    root = llff_folder.static
    expected = LlffReader(root, monocular=True).read().dynamic.train.cameras
    rows = llff_folder.static_rows()
    matrix = rows[:, :15].reshape(9, 3, 5)
    down, right = matrix[:, :, 0].copy(), matrix[:, :, 1].copy()
    matrix[:, :, 0], matrix[:, :, 1] = right, -down
    content = {
        "poses": matrix.tolist(),
        "bds": rows[:, 15:].tolist(),
        "render_poses": [],
        "i_test": 3,
    }
    (root / "poses_bounds.npy").unlink()
    (root / "precomputed.json").write_text(json.dumps(content))
    cameras = LlffReader(root).read().dynamic.train.cameras
    torch.testing.assert_close(cameras.camera_to_world, expected.camera_to_world)
    assert torch.equal(cameras.focal, expected.focal)


def test_the_near_plane_of_a_video_by_hand():
    """Eleven cameras look along −z: one stray point, and a camera that has gone 1 forward."""
    poses = torch.eye(4, dtype=torch.float64)[:3].repeat(11, 1, 1)
    bounds = torch.tensor([[0.1, 9.0], *[[4.0, 9.0]] * 10], dtype=torch.float64)
    intrinsics = (Intrinsics((20.0, 20.0), (12.0, 8.0), (24, 16)),) * 11
    side_by_side = PosedSet(Path("video"), poses, intrinsics, bounds)
    assert side_by_side.near_plane() == pytest.approx(3.0)
    moved = poses.clone()
    moved[5, 2, 3] = -1.0
    # What nine of ten see is at 4 or more; the camera that went forward is at 1.
    assert replace(side_by_side, poses=moved).near_plane() == pytest.approx(1 + 0.75 * 3)
    # Never nearer than the unit of LLFF's worlds.
    assert replace(side_by_side, bounds=bounds / 10).near_plane() == 1.0


def test_only_a_video_has_a_near_plane_of_its_own(llff_folder):
    def near(**options: Any) -> float:
        space = LlffReader(llff_folder.static, **options).read().space
        assert isinstance(space, NormalizedDevice)
        return space.near

    rows = llff_folder.static_rows()
    rows[1:, 15] *= 1.6  # one camera in nine sees what is nearest
    llff_folder.save(STATIC, rows)
    assert near(monocular=False) == 1.0
    assert near(monocular=True) > 1.2
    assert near(monocular=True, near=0.7) == 0.7


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
        (STATIC, (1, 0), 1, "camera 1: is no rigid transform"),
        (POSES, (4, 2, 4), 0, "focal length 0"),
        (BOUNDS, (1, 0), -1, "camera 1: expected 0 < least"),
    ],
)
def test_wrong_numbers(llff_folder, file, where, value, said, message_of):
    values = stored(llff_folder, file)
    values[where] = value
    llff_folder.save(file, values)
    assert said in message_of(llff_folder.root)


def test_missing_images(llff_folder, message_of):
    message = message_of(llff_folder.root, downscale=2)
    assert "no folder images_2 or images (found: images_4)" in message
    images = llff_folder.dynamic / "view2" / "images_4"
    (images / "002.png").unlink()
    assert f"{images}: has 2 images, but" in message_of(llff_folder.root)
    (images.parent).rename(llff_folder.dynamic / "view02")
    assert "no folder view2 although there is view3" in message_of(llff_folder.root)


def test_a_fixed_camera_that_looks_elsewhere(llff_folder, message_of):
    poses = stored(llff_folder, POSES)
    # A quarter turn about the vertical axis: right is back, back is left.
    poses[4, :, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    llff_folder.save(POSES, poses)
    message = message_of(llff_folder.root)
    assert "view3/images_4/000.png: its camera does not look along" in message


@pytest.mark.parametrize(
    ("options", "said"),
    [({"train_views": 3}, "the set has 2 views"), ({"test_view": 4}, "none of the 3 views")],
)
def test_wrong_options(llff_folder, options, said, message_of):
    assert said in message_of(llff_folder.root, **options)


def test_more_cameras_than_images_may_be(llff_folder, message_of):
    llff_folder.save(STATIC, np.zeros((50_001, 17), np.int8))  # in memory each byte would become 18
    assert "more than the cameras of a capture" in message_of(llff_folder.root)


def test_arrays_larger_than_their_file_take_no_memory(llff_folder, message_of):
    header = {"descr": "<f8", "fortran_order": False, "shape": (2**30, 17)}
    with (llff_folder.root / STATIC).open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
    message = message_of(llff_folder.root)
    assert f"{STATIC}: not a readable npy file (mmap length is greater than" in message

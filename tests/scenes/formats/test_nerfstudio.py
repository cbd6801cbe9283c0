"""nerfstudio's ``transforms.json``: cameras by geometry, lenses, splits, times, wrong input."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from devrf.data.kind import by_one_camera
from devrf.errors import DevrfError
from devrf.geometry.cameras import Distortion
from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.lens import Lens
from devrf.scenes.scene import Scene, Views

WIDTH, HEIGHT = 80, 60


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, NerfstudioReader)


@pytest.fixture
def moving(tmp_path, balls) -> Path:
    """Nine images of a moving camera."""
    balls.write(tmp_path / "scene", [i / 8 for i in range(9)])
    return tmp_path / "scene"


def listed(*numbers: int) -> list[str]:
    return [f"./images/r_{i:03d}.png" for i in numbers]


def test_points_fall_on_the_pixels_that_show_them(moving, balls_are_where_they_project):
    scene = NerfstudioReader(moving, downscale=2).read()
    assert scene.kind == "inward" and scene.name == "scene"
    train = scene.dynamic.train
    assert (train.width, train.height) == (WIDTH // 2, HEIGHT // 2)
    balls_are_where_they_project(train)
    balls_are_where_they_project(scene.dynamic.test)
    assert train.has_alpha and scene.bounds.box.contains(torch.zeros(3))


def test_each_frame_may_bring_its_own_lens(tmp_path, balls_are_where_they_project, balls):
    def lens(index: int) -> Lens:
        strength = Distortion((-0.04 * index, 0.0, 0.0, 0.0)) if index % 2 else Distortion()
        return Lens((80.0 + 2 * index, 80.0), (40.0 + index / 2, 30.0), strength)

    content = balls.write(tmp_path / "scene", [i / 8 for i in range(9)], lens=lens, shared={})
    for i, frame in enumerate(content["frames"]):
        frame |= {"fl_x": 80.0 + 2 * i, "fl_y": 80.0, "cx": 40 + i / 2, "cy": 30, "w": 80, "h": 60}
        frame |= {"k1": -0.04 * i} if i % 2 else {}
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    train = NerfstudioReader(tmp_path / "scene").read().dynamic.train
    balls_are_where_they_project(train)
    assert len(set(train.cameras.focal[:, 0].tolist())) == len(train)
    # What is not distorted is not zoomed either.
    assert train.cameras.focal[2].tolist() == [84.0, 80.0]


def test_a_moving_camera_without_a_static_set(moving, caplog):
    with caplog.at_level(logging.WARNING):
        scene = NerfstudioReader(moving).read()
    assert "no static set: the canonical field is learned from 8 of the 8" in caplog.text
    # The eighth of nine images is held out.
    assert scene.dynamic.test.names == ("images/r_007.png",)
    assert scene.static.train is scene.dynamic.train
    assert scene.dynamic.train.view.tolist() == list(range(8))
    torch.testing.assert_close(
        scene.dynamic.train.times, torch.tensor([0, 1, 2, 3, 4, 5, 6, 8]) / 8
    )


def test_times_in_the_order_of_the_names(tmp_path, balls):
    content = balls.write(tmp_path / "scene", [0.5] * 9)
    names = [f"images/frame {number}.png" for number in (11, 2, 9, 1, 10, 3, 30, 4, 5)]
    for frame, name in zip(content["frames"], names, strict=True):
        (tmp_path / "scene" / frame["file_path"]).rename(tmp_path / "scene" / name)
        frame["file_path"] = name
        frame.pop("time")
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    assert not NerfstudioReader(tmp_path / "scene").read().moves
    scene = NerfstudioReader(tmp_path / "scene", times="order").read()
    views = scene.dynamic
    found = dict(zip(views.train.names, views.train.times.tolist(), strict=True))
    found |= dict(zip(views.test.names, views.test.times.tolist(), strict=True))
    ordered = sorted(names, key=lambda name: int(name.split()[1][:-4]))
    assert found == pytest.approx({name: k / 8 for k, name in enumerate(ordered)})


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        (
            {
                "train_filenames": listed(0, 2, 4, 6),
                "val_filenames": listed(1),
                "test_filenames": listed(3, 5),
            },
            [0, 2, 4, 6],
            [3, 5],
        ),
        ({"val_filenames": listed(1, 8)}, [0, 2, 3, 4, 5, 6, 7], [1, 8]),
        ({"train_filenames": listed(0, 1, 2, 3, 4, 5)}, [0, 1, 2, 3, 4, 5], [6, 7, 8]),
    ],
)
def test_listed_splits(moving, lists, train, test, balls):
    balls.edit(moving, lambda c: c.update(lists))
    scene = NerfstudioReader(moving).read()
    assert scene.dynamic.train.names == tuple(n[2:] for n in listed(*train))
    assert scene.dynamic.test.names == tuple(n[2:] for n in listed(*test))


def test_the_validation_list_beside_a_test_list(moving, balls):
    lists = {"val_filenames": listed(1, 3), "test_filenames": listed(3, 5)}
    balls.edit(moving, lambda c: c.update(lists))
    assert NerfstudioReader(moving).read().dynamic.validation is None
    scene = NerfstudioReader(moving, validation=True).read()
    assert scene.dynamic.validation is not None
    # An image of both lists is a test image.
    assert scene.dynamic.validation.names == tuple(n[2:] for n in listed(1))
    assert scene.fingerprint == NerfstudioReader(moving).read().fingerprint
    balls.edit(moving, lambda c: c.pop("test_filenames"))
    scene = NerfstudioReader(moving, validation=True).read()
    assert len(scene.dynamic.test) == 2 and scene.dynamic.validation is None


def test_validation_views_are_in_the_world_of_the_others(tmp_path, balls):
    # Cameras that look along −z from z = 1 to 2, the world turned by a quarter about x.
    content = balls.write(tmp_path / "scene", None)
    for i, frame in enumerate(content["frames"]):
        pose = [[1, 0, 0, 0.1 * i], [0, 0, -1, -1 - i / 8], [0, 1, 0, 0], [0, 0, 0, 1]]
        frame["transform_matrix"] = pose
    content |= {"val_filenames": listed(4), "test_filenames": listed(8)}
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    options = {"space": "ndc", "near": 0.7, "validation": True}
    scene = NerfstudioReader(tmp_path / "scene", **options).read()
    assert scene.kind == "forward" and scene.dynamic.validation is not None
    (known,) = scene.dynamic.validation.cameras.camera_to_world
    first = scene.dynamic.train.cameras.camera_to_world[0]
    # Four steps of 0.1 to the right of the first camera, and of 1/8 backwards.
    torch.testing.assert_close(known[:, :3], torch.eye(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(
        known[:, 3] - first[:, 3], torch.tensor([0.4, 0.0, 0.5]), atol=1e-6, rtol=0
    )


def test_images_at_time_zero_are_the_static_set(tmp_path, balls_are_where_they_project, balls):
    # Ten images around the scene at rest; then two fixed cameras (of ten poses) at later times.
    later = [0.5] * 2 + [1.0] * 2
    content = balls.write(tmp_path / "scene", [0.0] * 10 + later, views=10)
    for i in range(10, 14):
        matrix = content["frames"][i % 2]["transform_matrix"]
        content["frames"][i]["transform_matrix"] = matrix
    content["test_filenames"] = listed(5, 6, 11)
    (tmp_path / "scene/transforms.json").write_text(json.dumps(content))
    scene = NerfstudioReader(tmp_path / "scene").read()
    assert len(scene.static.train) == 8 and not scene.static.train.times.any()
    assert scene.static.test.names == tuple(n[2:] for n in listed(5, 6))
    balls_are_where_they_project(scene.static.train)
    # The cameras that stay are seen at rest too; the others tell nothing of motion.
    train = scene.dynamic.train
    assert train.names == tuple(n[2:] for n in listed(0, 1, 10, 12, 13))
    assert train.view.tolist() == [0, 1, 0, 0, 1]
    assert scene.dynamic.test.names == (listed(11)[0][2:],)
    assert scene.clock.times == (0.0, 0.5, 1.0)
    # Validation views are of the scene in motion.
    balls.edit(tmp_path / "scene", lambda c: c.update(val_filenames=listed(7, 13)))
    validation = NerfstudioReader(tmp_path / "scene", validation=True).read().dynamic.validation
    assert validation is not None and validation.names == (listed(13)[0][2:],)
    balls.edit(tmp_path / "scene", lambda c: c.update(val_filenames=listed(7)))
    at_rest_alone = NerfstudioReader(tmp_path / "scene", validation=True).read()
    assert at_rest_alone.dynamic.validation is None


def test_two_folders(tmp_path, balls_are_where_they_project, balls):
    root = tmp_path / "scene"
    balls.write(root / "static", None)
    balls.write(root / "dynamic", [0.0, 0.0, 0.5, 0.5, 1.0, 1.0], views=2, turn=0.4)
    scene = NerfstudioReader(root, holdout=6).read()
    assert len(scene.static.train) == 8 and len(scene.static.test) == 1
    assert scene.dynamic.train.view.tolist() == [0, 1, 0, 1, 0]
    balls_are_where_they_project(scene.static.train)
    balls_are_where_they_project(scene.dynamic.train)
    thinned = NerfstudioReader(root, holdout=6, frames=2, train_views=1).read()
    assert thinned.dynamic.train.times.tolist() == [0.0, 1.0]
    lists = {"val_filenames": listed(3), "test_filenames": listed(4)}
    balls.edit(root / "dynamic", lambda c: c.update(lists))
    validation = NerfstudioReader(root, validation=True).read().dynamic.validation
    assert validation is not None and validation.names == ("dynamic/images/r_003.png",)


FAR = (500_000.0, 5_600_000.0, 200.0)


def carry(content: dict[str, Any]) -> None:
    """Move a file's cameras far from the origin."""
    for frame in content["frames"]:
        for row, step in zip(frame["transform_matrix"], FAR, strict=False):
            row[3] += step


def test_a_world_far_from_the_origin_is_read_as_the_same_near_it(tmp_path, balls, caplog):
    """Cameras at a distance of 4 from the balls; the second capture has the first one's offset."""
    root = tmp_path / "scene"
    balls.write(root / "static", None)
    balls.write(root / "dynamic", [0.0, 0.0, 0.5, 0.5, 1.0, 1.0], views=2, turn=0.4)
    near = NerfstudioReader(root, holdout=6, box=[[-1.5, -1.5, -1], [1.5, 1.5, 1]]).read()
    assert near.offset == (0, 0, 0) and "far from the origin" not in caplog.text
    for capture in ("static", "dynamic"):
        balls.edit(root / capture, carry)
    box = [[499_998.5, 5_599_998.5, 199.0], [500_001.5, 5_600_001.5, 201.0]]
    with caplog.at_level(logging.INFO):
        far = NerfstudioReader(root, holdout=6, box=box).read()
    assert far.offset == FAR and far.bounds == near.bounds
    assert caplog.text.count("scene is far from the origin: 500000, 5600000, 200 is sub") == 1
    assert far.fingerprint != near.fingerprint
    for ours, same in zip(parts(far), parts(near), strict=True):
        poses = same.cameras.camera_to_world
        torch.testing.assert_close(ours.cameras.camera_to_world, poses, rtol=0, atol=1e-6)
        assert torch.equal(ours.view, same.view)
    assert by_one_camera("nerfstudio", root / "dynamic") is False
    # What devrf itself says of the scene is in the world of the file.
    balls.edit(root / "static", lambda c: c.update(scene_bounds={"space": "world", "box": box}))
    assert NerfstudioReader(root, holdout=6).read().bounds.box == near.bounds.box


def test_a_film_far_from_the_origin_is_one_of_a_moving_camera(moving, balls):
    balls.edit(moving, carry)
    assert by_one_camera("nerfstudio", moving)
    film = NerfstudioReader(moving).read()
    assert film.is_monocular and film.offset == FAR


def test_a_stated_far_is_for_a_space_with_an_end(moving, balls):
    """A capture states what its points show, whatever the space; one that is typed is asked for."""
    stated = {"space": "contracted", "near": 0.5, "far": 9.0}
    balls.edit(moving, lambda c: c.update(scene_bounds=stated))
    unbounded, ended = (NerfstudioReader(moving, space=s).read() for s in ("auto", "world"))
    assert (unbounded.bounds.near, unbounded.bounds.far) == (0.5, math.inf)
    assert (ended.bounds.near, ended.bounds.far) == (0.5, 9.0)
    with pytest.raises(DevrfError, match=r"data.far: the scene is unbounded"):
        NerfstudioReader(moving, far=9.0).read()


def parts(scene: Scene) -> list[Views]:
    return [v for capture in (scene.static, scene.dynamic) for v in (capture.train, capture.test)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "'OPENCV_FISHEYE' is not supported"),
        (lambda c: c.pop("fl_x"), 'has no "camera_angle_x" (radians) and no "fl_x"'),
        (lambda c: c.update(w=60, h=80), "80x60 px, but its camera is one for 60x80 px"),
        (lambda c: c.update(test_filenames=["images/r_9.png"]), "lists 'images/r_9.png'"),
        (
            lambda c: c.update(train_filenames=listed(0, 1), test_filenames=listed(1)),
            "2 images to learn from, 1 held out, 1 of them both",
        ),
    ],
)
def test_wrong_values(moving, change, said, message_of, balls):
    balls.edit(moving, change)
    assert said in message_of(moving)


def test_a_file_of_numbers_without_end_is_not_read(tmp_path, message_of):
    with (tmp_path / "transforms.json").open("wb") as file:
        file.truncate(2**33)  # of zeros, which take no room on the disk
    assert message_of(tmp_path) == f"{tmp_path}/transforms.json: larger than 16 MiB; write it again"
    (tmp_path / "transforms.json").write_bytes(b"[" + b"[]," * 2**21)  # 1.2 GiB, were they read
    said = "more than 4,194,304 values; write it again"
    assert message_of(tmp_path) == f"{tmp_path}/transforms.json: {said}"

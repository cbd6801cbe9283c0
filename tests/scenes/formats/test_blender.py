"""Inward-facing scenes on disk: what is read, in which order, with which numbers."""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.data.priors import without_priors
from devrf.errors import DevrfError
from devrf.scenes.formats.blender import BlenderReader
from devrf.scenes.space import dynamic_only


def test_published_layout(scene_folder):
    scene = BlenderReader(scene_folder.root).read()
    assert (scene.name, scene.kind, scene.background) == ("scene", "inward", "white")
    assert scene.static.train.pixels.shape == (6, 24, 32, 4)
    assert scene.static.train.pixels.dtype == torch.uint8
    assert len(scene.static.test) == 2 and len(scene.dynamic.test) == 3
    train = scene.dynamic.train
    assert train.view.tolist() == [0, 1, 0, 1, 0, 1]
    assert train.times.tolist() == [0, 0, 0.5, 0.5, 1, 1]
    assert train.names[3] == "dynamic_2views/train/r_003.png"
    assert train.pixels[3, 10, 15].tolist() == [3, 100, 200, 255]
    assert scene.clock.times == (0.0, 0.5, 1.0)
    assert train.flow is None and not scene.is_monocular
    assert scene.static.train.times.tolist() == [0] * 6
    assert scene.static.train.view.tolist() == list(range(6))


def test_fixed_cameras_a_metre_apart_are_two_however_far_away(scene_folder):
    """Both cameras count as one where they are compared with their distance from the origin."""
    near = BlenderReader(scene_folder.root).read()

    def carry(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for row, step in zip(frame["transform_matrix"], (5e6, -3e6, 4e6), strict=False):
                row[3] += step

    for folder in (scene_folder.static, scene_folder.dynamic):
        for split in ("train", "test"):
            scene_folder.edit(folder / f"transforms_{split}.json", carry)
    far = BlenderReader(scene_folder.root).read()
    assert far.offset == (5e6, -3e6, 4e6)
    assert far.dynamic.train.view.tolist() == [0, 1, 0, 1, 0, 1]
    for name in ("static", "dynamic"):
        poses = near.capture(name).test.cameras.camera_to_world
        moved = far.capture(name).test.cameras.camera_to_world
        torch.testing.assert_close(moved, poses, rtol=0, atol=1e-6)


def test_camera_angle_becomes_a_focal_length_and_a_known_pixel(scene_folder):
    cameras = BlenderReader(scene_folder.root).read().static.train.cameras
    focal = 16 / math.tan(0.4)
    assert cameras.focal[0].tolist() == pytest.approx([focal, focal])
    assert cameras.center[0].tolist() == [16, 12]
    # Camera 0 stands at (√(16 − 1.44), 0, 1.2) and looks at the origin: +y is to its right.
    pixel, depth = cameras.project(torch.tensor([0]), torch.tensor([[0.0, 0.5, 0.0]]))
    assert pixel[0].tolist() == pytest.approx([16 + focal * 0.5 / 4, 12], abs=1e-4)
    assert float(depth) == pytest.approx(4, abs=1e-5)


@pytest.mark.parametrize(
    ("said", "focal"),
    [
        # 32×24 px: half a side by the tangent of half the angle.
        ({"camera_angle_x": 0.8, "camera_angle_y": 0.5}, (37.8435, 46.9958)),
        ({"camera_angle_y": 0.5}, (46.9958, 46.9958)),
        ({"camera_angle_x": 0.8, "camera_angle_y": 0.5, "fl_x": 50, "fl_y": 40}, (50, 40)),
        ({"camera_angle_y": 0.5, "fl_x": 50}, (50, 46.9958)),
        ({"camera_angle_x": 0.8, "fl_y": 40}, (37.8435, 40)),
        ({"camera_angle_y": 0.5, "w": 64, "h": 48}, (46.9958, 46.9958)),
    ],
)
def test_either_angle_gives_the_focal_length_of_its_axis(scene_folder, said, focal):
    def change(content):
        del content["camera_angle_x"]
        content.update(said)

    scene_folder.edit(scene_folder.static / "transforms_train.json", change)
    cameras = BlenderReader(scene_folder.root).read().static.train.cameras
    assert cameras.focal.tolist() == [pytest.approx(focal, abs=1e-4)] * 6
    assert cameras.center.tolist() == [[16, 12]] * 6


def test_one_side_alone_says_no_size(scene_folder, refusal):
    """Focal lengths would be taken for those of the file, however small it is."""
    file = scene_folder.static / "transforms_train.json"
    scene_folder.edit(file, lambda content: content.update(fl_x=100, w=64))
    message = refusal(BlenderReader, scene_folder.root)
    assert message == f'{file}: "w" and "h" go together, and one of them is missing; add it'


def test_the_view_that_a_frame_states_replaces_the_files(scene_folder):
    def change(content):
        content.update(camera_angle_x=0.8, camera_angle_y=0.5)
        first, second, third, *_ = content["frames"]
        first.update(camera_angle_y=0.4)
        second.update(fl_x=30.0)
        third.update(camera_angle_x=0.6, camera_angle_y=0.4)

    scene_folder.edit(scene_folder.static / "transforms_train.json", change)
    focal = BlenderReader(scene_folder.root).read().static.train.cameras.focal
    expected = [[59.1978, 59.1978], [30, 30], [51.7236, 59.1978], [37.8435, 46.9958]]
    assert focal[:4].tolist() == [pytest.approx(one, abs=1e-4) for one in expected]


def test_the_principal_point_of_a_crop_is_outside_the_image(scene_folder):
    file = scene_folder.static / "transforms_train.json"
    scene_folder.edit(file, lambda content: content.update(cx=-3.5, cy=0))
    box = [[-1, -1, -1], [1, 1, 1]]
    scene = BlenderReader(scene_folder.root, box=box, near=2.0, far=6.0).read()
    assert scene.static.train.cameras.center.tolist() == [[-3.5, 0]] * 6
    # What lies ahead of a camera falls beside its image.
    pixel, _ = scene.static.train.cameras.project(torch.tensor([0]), torch.zeros(1, 3))
    assert pixel[0].tolist() == pytest.approx([-3.5, 0], abs=1e-4)
    scene_folder.edit(file, lambda content: content.update(cx=-33000))
    with pytest.raises(DevrfError, match="cannot be one of 32x24 px"):
        BlenderReader(scene_folder.root, box=box, near=2.0, far=6.0).read()


def test_images_are_made_smaller_as_the_release_does_if_asked_to(scene_folder):
    whole = BlenderReader(scene_folder.root).read().static.train.pixels.float()
    by_alpha, straight = (
        BlenderReader(scene_folder.root, downscale=2, alpha_weighted=weighted).read()
        for weighted in (True, False)
    )
    count, height, width, channels = whole.shape
    means = whole.view(count, height // 2, 2, width // 2, 2, channels).mean(dim=(2, 4))
    assert (straight.static.train.pixels.float() - means).abs().max() <= 0.5
    assert torch.equal(by_alpha.static.train.pixels[..., 3], straight.static.train.pixels[..., 3])


def test_downscale_scales_each_axis_by_what_is_left_of_it(scene_folder):
    # 32×24 by 3: 10×8, so the focal lengths scale by 10/32 and 8/24.
    train = BlenderReader(scene_folder.root, downscale=3).read().dynamic.train
    assert train.pixels.shape == (6, 8, 10, 4)
    focal = 16 / math.tan(0.4)
    assert train.cameras.focal[0].tolist() == pytest.approx([focal * 10 / 32, focal / 3])
    assert train.cameras.center[0].tolist() == pytest.approx([5, 4])
    half = BlenderReader(scene_folder.root, downscale=2).read().dynamic.train
    assert half.pixels[1, 4, 6].tolist() == [1, 100, 200, 255]


def test_a_lens_is_undistorted_and_its_flow_files_are_left_out(scene_folder, caplog):
    flow = scene_folder.dynamic / "train_flow"
    flow.mkdir()
    for index in range(2, 6):
        np.savez(flow / f"{index:03d}_bwd.npz", flow=np.zeros((24, 32, 2)), mask=np.ones((24, 32)))
    assert BlenderReader(scene_folder.root).read().dynamic.train.flow is not None
    file = scene_folder.dynamic / "transforms_train.json"
    # Pincushion: the pinhole needs a longer focal length to see no empty border.
    scene_folder.edit(file, lambda content: content.update(k1=0.3))
    train = BlenderReader(scene_folder.root).read().dynamic.train
    assert train.flow is None and "left out: they are for images before undistortion" in caplog.text
    assert float(train.cameras.focal[0, 0]) > 16 / math.tan(0.4) + 0.5


def test_beside_absent_images_flow_files_are_left_out_where_there_are_some(scene_folder, caplog):
    caplog.set_level(logging.INFO)
    (scene_folder.dynamic / "train/r_003.png").unlink()
    reader = BlenderReader(scene_folder.root, missing="skip")
    assert reader.read().dynamic.train.flow is None
    assert "flow files" not in caplog.text and "no optical flow: no " in caplog.text
    flow = scene_folder.dynamic / "train_flow"
    flow.mkdir()
    np.savez(flow / "002_bwd.npz", flow=np.zeros((24, 32, 2)), mask=np.ones((24, 32)))
    assert reader.read().dynamic.train.flow is None
    assert f"flow files in {flow} left out: they number images that are left out" in caplog.text


def test_frames_keeps_the_first_and_the_last_time(scene_folder, caplog):
    caplog.set_level(logging.INFO)
    scene = BlenderReader(scene_folder.root, frames=2).read()
    assert scene.dynamic.train.times.tolist() == [0, 0, 1, 1]
    assert scene.dynamic.test.times.tolist() == [0, 1]
    assert scene.dynamic.train.flow is None and "no flow files are read" in caplog.text
    assert len(BlenderReader(scene_folder.root, frames=3).read().dynamic.train) == 6


def test_fewer_frames_leave_held_out_images_of_times_of_their_own(single_folder, scene_folder):
    """First and last time alone are among those learned from: two images of four were scored."""

    def from_first_to_last(content: dict[str, Any]) -> None:
        for frame, time in zip(content["frames"], (0.0, 0.4, 1.0), strict=True):
            frame["time"] = time
        content["frames"].insert(
            2, content["frames"][1] | {"file_path": "./test/r_003", "time": 0.6}
        )

    shutil.copy(single_folder / "test/r_001.png", single_folder / "test/r_003.png")
    scene_folder.edit(single_folder / "transforms_test.json", from_first_to_last)
    dynamic = BlenderReader(single_folder, frames=4).read().dynamic
    assert len(dynamic.train) == 4
    assert dynamic.test.times.tolist() == pytest.approx([0.0, 0.4, 0.6, 1.0])


def test_flow_belongs_to_the_place_in_the_file(scene_folder):
    folder = scene_folder.dynamic / "train_flow"
    folder.mkdir()
    for index in range(2, 6):
        vectors = np.full((24, 32, 2), float(index), dtype=np.float32)
        np.savez(folder / f"{index:03d}_bwd.npz", flow=vectors, mask=np.ones((24, 32), bool))
    flow = BlenderReader(scene_folder.root, downscale=3).read().dynamic.train.flow
    assert flow is not None and flow.vectors.shape == (6, 8, 10, 2)
    assert not flow.valid[:2].any() and flow.valid[2:].all()
    assert flow.vectors[5, 3, 4].tolist() == pytest.approx([5 * 10 / 32, 5 / 3])
    second = BlenderReader(scene_folder.root, train_views=1).read().dynamic.train.flow
    assert second is not None and second.vectors[:, 0, 0, 0].tolist() == [0, 2, 4]
    assert BlenderReader(scene_folder.root, flow="none").read().dynamic.train.flow is None


def test_images_are_found_without_suffix_and_may_lack_alpha(scene_folder):
    folder = scene_folder.static / "test"
    for path in list(folder.iterdir()):
        iio.imwrite(path.with_suffix(".webp"), np.full((24, 32, 3), 77, dtype=np.uint8))
        path.unlink()
    test = BlenderReader(scene_folder.root).read().static.test
    assert not test.has_alpha and test.names[0] == "static/test/r_000.webp"
    assert bool(((test.pixels.int() - 77).abs() <= 1).all())


def test_single_folder_learns_the_static_scene_from_early_images(single_folder, caplog):
    scene = BlenderReader(single_folder, static_until=0.5).read()
    assert len(scene.static.train) == 4 and len(scene.dynamic.train) == 8
    assert scene.static.test.times.tolist() == pytest.approx([0.1, 0.4])
    assert scene.dynamic.train.view.tolist() == list(range(8))
    assert torch.equal(scene.static.train.pixels, scene.dynamic.train.pixels[:4])
    assert "no static set" in caplog.text
    assert scene.bounds.motion is None  # never two cameras at one time
    whole = BlenderReader(single_folder).read()
    assert len(whole.static.train) == 8 and len(whole.static.test) == 3


@pytest.mark.parametrize("static_until", [0.5, 1.0])
def test_a_film_keeps_its_bounds_where_a_method_has_no_static_set(single_folder, static_until):
    read = BlenderReader(single_folder, static_until=static_until, near=0.3, far=9.0).read()
    for scene in (read, without_priors(read)):
        assert scene.is_monocular
        alone = dynamic_only(scene)
        assert alone.bounds == scene.bounds and (alone.bounds.near, alone.bounds.far) == (0.3, 9.0)


@pytest.mark.parametrize(("name", "images"), [("lego", 2), ("other", 3)])
def test_lego_of_dnerf_is_scored_on_its_val_split(single_folder, caplog, monkeypatch, name, images):
    root = single_folder.rename(single_folder.with_name(name))
    val = with_val(root)
    content = json.loads(val.read_text())
    val.write_text(json.dumps({**content, "frames": content["frames"][:2]}))
    monkeypatch.chdir(root)
    for typed in (root, "."):
        caplog.clear()
        with caplog.at_level("INFO"):
            scene = BlenderReader(typed).read()
        assert len(scene.dynamic.test) == images
        assert ("test split shows another scene" in caplog.text) == (name == "lego")


def shifted(content: dict[str, Any], meters: float) -> None:
    for frame in content["frames"]:
        frame["transform_matrix"][2][3] += meters


def with_val(folder: Path) -> Path:
    """The test split of a folder once more, as its validation split."""
    shutil.copy(folder / "transforms_test.json", folder / "transforms_val.json")
    return folder / "transforms_val.json"


def test_the_validation_split_is_read_where_it_is_asked_for(scene_folder):
    plain = BlenderReader(scene_folder.root).read()
    val = with_val(scene_folder.dynamic)
    scene_folder.edit(val, lambda content: shifted(content, 0.25))
    assert BlenderReader(scene_folder.root).read().dynamic.validation is None
    scene = BlenderReader(scene_folder.root, validation=True, downscale=2).read()
    validation = scene.dynamic.validation
    assert validation is not None and validation.pixels.shape == (3, 12, 16, 4)
    assert validation.times.tolist() == [0, 0.5, 1]
    moved = validation.cameras.positions - scene.dynamic.test.cameras.positions
    torch.testing.assert_close(moved, torch.tensor([[0.0, 0.0, 0.25]] * 3))
    assert scene.static.validation is None
    # The scene is the same one.
    same = BlenderReader(scene_folder.root, validation=True).read()
    assert (same.fingerprint, same.bounds) == (plain.fingerprint, plain.bounds)
    thinned = BlenderReader(scene_folder.root, validation=True, frames=2).read().dynamic.validation
    assert thinned is not None and thinned.times.tolist() == [0, 1]


def test_of_a_scene_at_rest_the_static_validation_split_is_read(scene_folder):
    shutil.rmtree(scene_folder.dynamic)
    scene_folder.edit(with_val(scene_folder.static), lambda content: shifted(content, 0.25))
    scene = BlenderReader(scene_folder.root, validation=True).read()
    assert not scene.moves and scene.dynamic.validation is not None
    assert scene.dynamic.validation.times.tolist() == [0, 0]


def test_images_that_are_learned_from_or_tested_on_are_no_validation(scene_folder):
    val = with_val(scene_folder.dynamic)
    assert BlenderReader(scene_folder.root, validation=True).read().dynamic.validation is None
    train = json.loads((scene_folder.dynamic / "transforms_train.json").read_text())["frames"]
    new = {**train[0], "time": 0.25}
    scene_folder.edit(val, lambda content: content["frames"].extend([train[3], new]))
    validation = BlenderReader(scene_folder.root, validation=True).read().dynamic.validation
    assert validation is not None and validation.times.tolist() == [0.25]
    # Without a test split it is held out in its place.
    (scene_folder.dynamic / "transforms_test.json").unlink()
    scene = BlenderReader(scene_folder.root, validation=True).read()
    assert len(scene.dynamic.test) == 5 and scene.dynamic.validation is None


def test_a_validation_split_without_an_image_is_none(single_folder):
    """Blender's add-ons write all three files, and some people keep the training images alone."""
    with_val(single_folder)
    shutil.rmtree(single_folder / "test")
    scene = BlenderReader(single_folder, validation=True).read()
    assert len(scene.dynamic.test) == 1 and scene.dynamic.validation is None


NAN = float("nan")
TRAIN = "static/transforms_train.json"
MOVING = "dynamic_2views/transforms_train.json"


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, BlenderReader)


def in_first_frame(key: str, value: object) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["frames"][0].__setitem__(key, value)


def without(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["frames"][0].pop(key)


def pose(first: object) -> list[list[object]]:
    return [[first, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        (TRAIN, lambda c: c.pop("frames"), "frames: is missing"),
        (TRAIN, lambda c: c.pop("camera_angle_x"), '"camera_angle_x"'),
        (TRAIN, lambda c: c.update(camera_angle_y=3.2), "camera_angle_y is 3.2, expected radians"),
        (
            TRAIN,
            in_first_frame("transform_matrix", pose(NAN)),
            "transform_matrix[0][0]: expected a finite number, not nan",
        ),
        (TRAIN, in_first_frame("transform_matrix", pose(-1)), "no rigid transform"),
        (MOVING, in_first_frame("time", 1.5), "frames[0].time: 1.5 is outside [0, 1]"),
        (MOVING, without("time"), 'frames[0]: has no "time" although others have'),
    ],
)
def test_wrong_json_values(scene_folder, file, change, said, message_of):
    path = scene_folder.root / file
    scene_folder.edit(path, change)
    message = message_of(scene_folder.root)
    assert str(path) in message and said in message


def test_poses_are_looked_at_before_images_are_looked_for(scene_folder, message_of):
    """Of 50,000 frames the latter takes a minute."""
    scene_folder.edit(scene_folder.root / TRAIN, in_first_frame("transform_matrix", pose(-1)))
    (scene_folder.static / "train" / "r_000.png").unlink()
    assert "frames[0]: transform_matrix: is no rigid" in message_of(scene_folder.root)


def test_several_captures_are_listed(scene_folder, message_of):
    shutil.copytree(scene_folder.dynamic, scene_folder.root / "dynamic_3views")
    message = message_of(scene_folder.root)
    assert "dynamic_2views, dynamic_3views" in message and "data.dynamic=" in message
    assert "'dynamic_4views'" in message_of(scene_folder.root, dynamic="dynamic_4views")
    train = BlenderReader(scene_folder.root, dynamic="dynamic_3views").read().dynamic.train
    assert train.names[0].startswith("dynamic_3views/")


def test_image_paths_stay_inside_the_scene(scene_folder, message_of):
    path = scene_folder.root / TRAIN
    for escape in ("../../secret", "/etc/passwd"):
        scene_folder.edit(path, in_first_frame("file_path", escape))
        message = message_of(scene_folder.root)
        assert str(path) in message and "outside the scene's folder" in message


def test_links_that_lie_in_the_scene_are_followed(scene_folder, tmp_path):
    (scene_folder.static / "train").rename(tmp_path / "elsewhere")
    (scene_folder.static / "train").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "scene").rename(tmp_path / "moved")
    (tmp_path / "link").symlink_to(tmp_path / "moved")
    assert BlenderReader(tmp_path / "link").read().static.train.names[0] == "static/train/r_000.png"


def test_fixed_views_without_times_have_to_take_turns(scene_folder, message_of):
    def shuffle(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            del frame["time"]
        content["frames"].sort(key=lambda f: f["transform_matrix"][0][3])

    path = scene_folder.root / MOVING
    scene_folder.edit(path, shuffle)
    scene_folder.edit(scene_folder.dynamic / "transforms_test.json", shuffle)
    message = message_of(scene_folder.root)
    assert str(path) in message and "2 fixed views do not take turns" in message


def test_absent_images_of_fixed_views_without_times_have_their_turn(scene_folder):
    def untimed(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            del frame["time"]

    for name in ("train", "test"):
        scene_folder.edit(scene_folder.dynamic / f"transforms_{name}.json", untimed)
    whole = BlenderReader(scene_folder.root).read().dynamic.train
    for k in (0, 3):  # then the images that are there take turns no more
        (scene_folder.dynamic / f"train/r_{k:03d}.png").unlink()
    train = BlenderReader(scene_folder.root, missing="skip").read().dynamic.train
    kept = torch.tensor([1, 2, 4, 5])
    assert train.names == whole[kept].names
    assert train.times.tolist() == whole.times[kept].tolist()
    assert train.view.tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"downscale": 4}, "8x6 px"),
        ({"background": "grey"}, "data.background: expected 'white', 'black' or 'random'"),
        *(({"bound_scale": scale}, "data.bound_scale") for scale in (0.5, "large")),
        ({"box": 3}, "data.box"),
    ],
)
def test_wrong_options(scene_folder, options, said, message_of):
    assert said in message_of(scene_folder.root, **options)

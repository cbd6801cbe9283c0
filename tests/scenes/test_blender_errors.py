"""Wrong input: one line that names the file, what was expected, and what to do."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from devrf.scenes.formats.blender import BlenderReader

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
        (TRAIN, lambda c: c.update(frames=[]), "frames: list should have at least 1 item"),
        (TRAIN, lambda c: c.update(frames={}), "frames: should be a valid array"),
        (TRAIN, lambda c: c.update(frames=[3]), "frames[0]: should be an object, not 3"),
        (TRAIN, lambda c: c.pop("camera_angle_x"), '"camera_angle_x"'),
        (TRAIN, lambda c: c.update(camera_angle_x=0), "camera_angle_x is 0"),
        (
            TRAIN,
            lambda c: c.update(camera_angle_x=NAN),
            "camera_angle_x: should be a finite number, not nan",
        ),
        (TRAIN, lambda c: c.update(camera_angle_x=4.0), "camera_angle_x is 4.0"),
        (TRAIN, lambda c: c.update(fl_x=-3), "fl_x: should be greater than 0, not -3"),
        (TRAIN, without("transform_matrix"), "frames[0].transform_matrix: is missing"),
        (
            TRAIN,
            in_first_frame("transform_matrix", pose(NAN)),
            "transform_matrix[0][0]: should be a finite number, not nan",
        ),
        (
            TRAIN,
            in_first_frame("transform_matrix", pose("1")),
            "[0][0]: should be a valid number, not '1'",
        ),
        (TRAIN, in_first_frame("transform_matrix", pose(10**400)), "[0][0]: should be"),
        (TRAIN, in_first_frame("transform_matrix", pose(-1)), "no rigid transform"),
        (TRAIN, in_first_frame("transform_matrix", pose(2)), "no rigid transform"),
        (
            TRAIN,
            in_first_frame("transform_matrix", pose(1)[:2]),
            "list should have at least 3 items, not 2",
        ),
        (TRAIN, in_first_frame("transform_matrix", [[1, 0, 0]] * 3), "[0][3]: is missing"),
        (TRAIN, without("file_path"), "frames[0].file_path: is missing"),
        (TRAIN, in_first_frame("file_path", "a\0b"), "is not a path"),
        (MOVING, in_first_frame("time", 1.5), "frames[0].time: 1.5 is outside [0, 1]"),
        (MOVING, in_first_frame("time", NAN), "time: should be a finite number"),
        (MOVING, without("time"), 'frames[0]: has no "time" although others have'),
        (MOVING, lambda c: [f.update(time=0.3) for f in c["frames"]], "distinct times"),
    ],
)
def test_wrong_json_values(scene_folder, file, change, said, message_of):
    path = scene_folder.root / file
    scene_folder.edit(path, change)
    message = message_of(scene_folder.root)
    assert str(path) in message and said in message


@pytest.mark.parametrize("text", ["", "{", "[1]", "\xff", "[" * 100_000])
def test_json_that_is_none(scene_folder, text, message_of):
    path = scene_folder.root / TRAIN
    path.write_bytes(text.encode("latin-1"))
    assert str(path) in message_of(scene_folder.root)


def test_missing_folders(scene_folder, tmp_path, message_of):
    assert "nowhere: no such folder" in message_of(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "expected static/ and dynamic_<V>views/" in message_of(tmp_path / "empty")
    shutil.rmtree(scene_folder.dynamic)
    message = message_of(scene_folder.root, dynamic="dynamic_2views")
    assert "no folder 'dynamic_2views' (found: none)" in message


def test_a_dynamic_capture_without_a_static_one(scene_folder, message_of):
    shutil.rmtree(scene_folder.static)
    assert f"{scene_folder.static}: no such folder" in message_of(scene_folder.root)


def test_several_captures_are_listed(scene_folder, message_of):
    shutil.copytree(scene_folder.dynamic, scene_folder.root / "dynamic_3views")
    message = message_of(scene_folder.root)
    assert "dynamic_2views, dynamic_3views" in message and "data.dynamic=" in message
    wrong = message_of(scene_folder.root, dynamic="dynamic_4views")
    assert "'dynamic_4views'" in wrong and "dynamic_3views" in wrong


@pytest.mark.parametrize("capture", ["static", "dynamic_2views"])
def test_a_missing_test_split(scene_folder, capture, message_of):
    path = scene_folder.root / capture / "transforms_test.json"
    path.unlink()
    assert f"{path}: no such file" in message_of(scene_folder.root)


@pytest.mark.parametrize("escape", ["../../secret", "/etc/passwd", "train/../../../x"])
def test_image_paths_stay_inside_the_scene(scene_folder, escape, message_of):
    path = scene_folder.root / TRAIN
    scene_folder.edit(path, in_first_frame("file_path", escape))
    message = message_of(scene_folder.root)
    assert str(path) in message and "outside the scene's folder" in message


def test_links_that_lie_in_the_scene_are_followed(scene_folder, tmp_path):
    (scene_folder.static / "train").rename(tmp_path / "elsewhere")
    (scene_folder.static / "train").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "scene").rename(tmp_path / "moved")
    (tmp_path / "link").symlink_to(tmp_path / "moved")
    assert BlenderReader(tmp_path / "link").read().static.train.names[0] == "static/train/r_000.png"


def test_text_does_not_leave_through_a_link(scene_folder, tmp_path, message_of):
    """For the system ``link/..`` is where the link leads; here it is the scene's folder."""
    (tmp_path / "elsewhere" / "images").mkdir(parents=True)
    (scene_folder.static / "train/r_000.png").rename(tmp_path / "elsewhere/secret.png")
    (scene_folder.static / "link").symlink_to(tmp_path / "elsewhere/images")
    path = scene_folder.root / TRAIN
    scene_folder.edit(path, in_first_frame("file_path", "link/../secret.png"))
    message = message_of(scene_folder.root)
    assert f"{scene_folder.static}/secret.png: no such image" in message


def test_a_scene_beside_the_current_folder(scene_folder, monkeypatch):
    monkeypatch.chdir(scene_folder.static)
    assert BlenderReader("..").read().static.train.names[0] == "static/train/r_000.png"
    inner = str(scene_folder.static / "train/r_001.png")
    scene_folder.edit(scene_folder.root / TRAIN, in_first_frame("file_path", inner))
    assert BlenderReader(Path("..")).read().static.train.names[0] == "static/train/r_001.png"


def test_a_missing_image(scene_folder, message_of):
    (scene_folder.static / "train/r_002.png").unlink()
    message = message_of(scene_folder.root)
    assert str(scene_folder.static / "train/r_002") in message and "no such image" in message


@pytest.mark.parametrize("keep", [0, 20, 60])
def test_a_damaged_image(scene_folder, keep, message_of):
    path = scene_folder.static / "train/r_001.png"
    path.write_bytes(path.read_bytes()[:keep])
    assert f"{path}: not a readable image" in message_of(scene_folder.root)


def test_images_of_two_sizes(scene_folder, message_of):
    path = scene_folder.dynamic / "train/r_004.png"
    iio.imwrite(path, np.zeros((32, 24, 4), dtype=np.uint8))
    message = message_of(scene_folder.root)
    assert str(path) in message and "24x32" in message and "32x24" in message


def test_sixteen_bit_images(scene_folder, message_of):
    path = scene_folder.static / "test/r_000.png"
    iio.imwrite(path, np.zeros((24, 32), dtype=np.uint16))
    assert f"{path}: expected 8 bits a channel" in message_of(scene_folder.root)


@pytest.mark.parametrize("side", [10_500, 2**31 - 1])
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_header_that_claims_too_much_is_refused_before_decoding(scene_folder, side, message_of):
    path = scene_folder.static / "train/r_003.png"
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0)
    content = path.read_bytes()
    check = struct.pack(">I", zlib.crc32(header))
    path.write_bytes(content[:12] + header + check + content[33:])
    assert f"{path}: the image claims more than 100 megapixels" in message_of(scene_folder.root)


def test_flow_of_another_size(scene_folder, message_of):
    folder = scene_folder.dynamic / "train_flow"
    folder.mkdir()
    np.savez(folder / "002_bwd.npz", flow=np.zeros((12, 16, 2)), mask=np.ones((12, 16), bool))
    message = message_of(scene_folder.root, downscale=2)
    assert "002_bwd.npz" in message and "(24, 32, 2)" in message and "data.flow=none" in message
    assert BlenderReader(scene_folder.root, flow="none").read().dynamic.train.flow is None


def test_fixed_views_without_times_have_to_take_turns(scene_folder, message_of):
    def shuffle(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            del frame["time"]
        content["frames"].sort(key=lambda f: f["transform_matrix"][0][3])

    path = scene_folder.root / MOVING
    scene_folder.edit(path, shuffle)
    message = message_of(scene_folder.root)
    assert str(path) in message and "2 fixed views do not take turns" in message


def test_views_that_are_not_there(scene_folder, single_folder, message_of):
    assert "the set has 2 views" in message_of(scene_folder.root, train_views=3)
    assert "needs fixed cameras" in message_of(single_folder, train_views=1)


def test_no_image_early_enough_for_the_static_scene(scene_folder, single_folder, message_of):
    def later(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["time"] = 0.5 + frame["time"] / 2

    scene_folder.edit(single_folder / "transforms_train.json", later)
    message = message_of(single_folder, static_until=0.1)
    assert str(single_folder / "transforms_train.json") in message
    assert "data.static_until=0.1" in message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"downscale": 0}, "data.downscale"),
        ({"downscale": 2.5}, "data.downscale"),
        ({"downscale": 4}, "8x6 px"),
        ({"background": "grey"}, "data.background: should be 'white', 'black' or 'random'"),
        ({"flow": "farneback"}, "data.flow: should be 'auto', 'files', 'dis', 'raft' or 'none'"),
        *(({"bound_scale": scale}, "data.bound_scale") for scale in (0.5, "large", NAN, True)),
        ({"frames": 1}, "data.frames"),
        ({"train_views": 0}, "data.train_views"),
        ({"box": [[0, 0, 0], [1, 1, 0]]}, "data.box"),
        ({"box": 3}, "data.box"),
        ({"near": 5, "far": 2}, "0 <= near < far"),
        ({"near": NAN}, "data.near"),
        ({"static_until": 2}, "data.static_until"),
    ],
)
def test_wrong_options(scene_folder, options, said, message_of):
    assert said in message_of(scene_folder.root, **options)

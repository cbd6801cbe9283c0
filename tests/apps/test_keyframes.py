"""A path goes smoothly through its keyframes; its file is devrf's own, or nerfstudio's."""

from __future__ import annotations

import json
import math
import re
import time

import pytest
import torch
from pydantic import ValidationError

from devrf.apps.keyframes import (
    CameraPath,
    Keyframe,
    _PathFile,
    cameras_of,
    check_name,
    hermite,
    keyframes_of,
    path_from,
    read_path,
    write_path,
)
from devrf.apps.render import camera_path
from devrf.apps.video import VideoSettings
from devrf.errors import DevrfError


def keyframe(seconds, x=0.0, turn=0.0, fov=60.0, time=0):
    """A camera at (x, 0, 0), turned about the vertical axis by ``turn`` degrees."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    pose = torch.tensor([[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 0]], dtype=torch.float32)
    return Keyframe(pose, fov, time, seconds)


def at(path, *moments):
    return path.at(torch.tensor(moments, dtype=torch.float64))


def test_a_spline_by_hand():
    # Slopes 1, 0, -1: between 0 and 1 it is u + u² - u³.
    knots, values = torch.tensor([0.0, 1.0, 2.0]), torch.tensor([[0.0], [1.0], [0.0]])
    found = hermite(knots, values, torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]))
    assert found[:, 0].tolist() == [0.0, 0.625, 1.0, 0.625, 0.0]


def test_keyframes_at_uneven_moments_are_met():
    frames = (
        keyframe(0, 0, 0, 40, 0.0),
        keyframe(0.5, 2, 100, 50, 0.3),
        keyframe(4, 1, 200, 60, 0.3),
    )
    for found, given in zip(at(CameraPath(frames, 1, 10), 0, 0.5, 4), frames, strict=True):
        torch.testing.assert_close(found.camera_to_world, given.camera_to_world)
        assert (found.fov, found.time) == pytest.approx((given.fov, given.time))
    times = [frame.time for frame in at(CameraPath(frames, 1, 10), 0.25, 2, 3)]
    assert times == pytest.approx([0.15, 0.3, 0.3])  # it stands still between two of the same time


def test_a_whole_turn_goes_one_way():
    # A quaternion and its negative are one rotation: the signs have to follow one another.
    path = CameraPath(tuple(keyframe(k, turn=60 * k) for k in range(7)), 1, 10)
    for moment in (1.5, 3.5, 5.5):
        (found,) = at(path, moment)
        expected = keyframe(0, turn=60 * moment).camera_to_world
        torch.testing.assert_close(found.camera_to_world, expected, atol=0.02, rtol=0)


def test_a_path_has_both_its_ends():
    path = CameraPath((keyframe(1), keyframe(3, x=1.0)), 1.5, 10)
    assert (path.duration, path.frames) == (2, 21)
    assert [one.seconds for one in path.sampled(3)] == [1, 2, 3]
    with pytest.raises(DevrfError, match="expected at most 90000 frames"):
        _ = CameraPath((keyframe(0), keyframe(1e7)), 1, 10).frames


def test_cameras_see_the_angle():
    cameras = cameras_of([keyframe(0, fov=90.0)], aspect=2.0, height=100)
    assert (cameras.width, cameras.height, cameras.center.tolist()) == (200, 100, [[100, 50]])
    assert cameras.focal.tolist() == [[pytest.approx(50.0)] * 2]
    (back,) = keyframes_of(cameras, [0.3], 7.0)
    assert (back.fov, back.time, back.seconds) == (pytest.approx(90.0), 0.3, 0.0)


# Looks along −x from (1, 2, 3), row by row.
MATRIX = [0, 0, 1, 1, 1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 0, 1]
POSE = torch.tensor(MATRIX, dtype=torch.float32).view(4, 4)[:3]


def frame(**more):
    return {"matrix": MATRIX, "fov": 50, "aspect": 1.5, "render_time": 0, "seconds": 0, **more}


def content(**keys):
    return json.dumps(keys).encode()


def test_what_is_saved_is_read(tmp_path):
    further = torch.cat([POSE[:, :3], torch.tensor([[4.0], [5.0], [6.0]])], dim=1)
    keyframes = (Keyframe(POSE, 50.0, 0.2, 1.0), Keyframe(further, 70.0, 0.8, 3.0))
    write_path(tmp_path / "paths" / "a.json", CameraPath(keyframes, 1.5, 4.0), 200)
    saved = json.loads((tmp_path / "paths" / "a.json").read_text())
    # nerfstudio's own keys: a camera a frame.
    assert (saved["render_width"], saved["render_height"], saved["seconds"]) == (300, 200, 2)
    assert saved["camera_type"] == "perspective" and len(saved["camera_path"]) == 9
    first = {"camera_to_world": MATRIX, "fov": 50.0, "aspect": 1.5, "render_time": 0.2}
    assert saved["camera_path"][0] == first
    found = read_path(tmp_path / "paths" / "a.json")
    assert (found.aspect, found.fps, found.duration) == (1.5, 4.0, 2.0)
    for one, given in zip(found.keyframes, keyframes, strict=True):
        torch.testing.assert_close(one.camera_to_world, given.camera_to_world)
        assert (one.fov, one.time, one.seconds) == (given.fov, given.time, given.seconds - 1)


def test_files_have_the_positions_of_the_captures_world(tmp_path):
    offset = (500_000.0, 5_600_000.0, 200.0)
    further = torch.cat([POSE[:, :3], torch.tensor([[1.1], [2.2], [3.3]])], dim=1)
    keyframes = (Keyframe(POSE, 50.0, 0.2, 0.0), Keyframe(further, 50.0, 0.8, 1.0))
    write_path(tmp_path / "a.json", CameraPath(keyframes, 1.5, 4.0), 200, offset)
    saved = json.loads((tmp_path / "a.json").read_text())
    for matrix in (saved["keyframes"][1]["matrix"], saved["camera_path"][-1]["camera_to_world"]):
        assert matrix[3::4][:3] == pytest.approx([500_001.1, 5_600_002.2, 203.3], rel=0, abs=1e-6)
    for path in (
        read_path(tmp_path / "a.json", offset),
        path_from((tmp_path / "a.json").read_bytes(), "a", offset),
    ):
        torch.testing.assert_close(path.keyframes[1].camera_to_world, further, rtol=0, atol=1e-6)


def test_nerfstudios_file_gives_a_keyframe_for_each_camera():
    camera = {"camera_to_world": MATRIX, "fov": 40, "aspect": 1.25}
    # As its viewer writes keyframes: without seconds; in earlier versions with a matrix in text.
    told = {"matrix": str(MATRIX), "fov": 40, "aspect": 1.25, "properties": "[]"}
    path = path_from(content(keyframes=[told], camera_path=[camera] * 3, fps=2, crop=None), "p")
    assert [one.seconds for one in path.keyframes] == [0, 0.5, 1]
    assert [one.time for one in path.keyframes] == [0, 0.5, 1]
    assert (path.aspect, path.fps, path.keyframes[0].fov) == (1.25, 2, 40)
    torch.testing.assert_close(path.keyframes[2].camera_to_world, POSE)


SCALED = [2 * value for value in MATRIX[:12]] + MATRIX[12:]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"{", "p: not valid JSON"),
        (b" " * (2**24 + 1), "p: larger than 16 MiB"),
        (b"[" + b"[]," * 2**21, "p: more than 4,194,304 values; expected a path"),
        (content(fps=24), "p: holds no camera path"),
        *[(content(keyframes=[frame()], fps=x), "p: fps: ") for x in (1e-300, 0, -1, 1e30)],
        (content(keyframes=[frame(aspect=1e30)]), "p: keyframes[0].aspect: "),
        (content(keyframes=[frame(fov=190)]), "p: keyframes[0].fov: "),
        (content(keyframes=[frame(matrix=SCALED)]), "p: keyframes[0].matrix: is no rigid"),
        (content(keyframes=[frame(), frame()]), "p: keyframes[1].seconds: "),
        (
            content(camera_path=[{"camera_to_world": MATRIX, "fov": 1}] * 90_001),
            "p: camera_path: expected at most 90000 items, not 90001",
        ),
    ],
)
def test_what_is_no_path_is_refused_in_one_line(data, expected):
    with pytest.raises(DevrfError, match=f"^{re.escape(expected)}"):
        path_from(data, "p")


def test_a_file_of_too_long_a_video_is_named(tmp_path):
    file = tmp_path / "a.json"
    for keys, said in (
        # A frame more than there may be.
        ({"keyframes": [frame(), frame(seconds=90_000)], "fps": 1}, "the path takes 90000 s at 1 "),
        ({"keyframes": [frame(), frame()]}, "keyframes[1].seconds: "),
    ):
        file.write_bytes(content(**keys))
        with pytest.raises(DevrfError, match=f"^{re.escape(f'{file}: {said}')}"):
            camera_path(VideoSettings(path=str(file)))
    file.write_bytes(content(keyframes=[frame(), frame(seconds=89_999)], fps=1))
    path = camera_path(VideoSettings(path=str(file)))
    assert path is not None and path.frames == 90_000


@pytest.mark.parametrize("key", ["camera_path", "keyframes"])
def test_of_many_wrong_cameras_one_error_is_made(key):
    """Of 16 MiB of them, the errors took 8 GiB."""
    with pytest.raises(ValidationError) as raised:
        _PathFile.model_validate_json(content(**{key: [{"seconds": 1}] * 1000}))
    assert raised.value.error_count() <= 3  # of the first


def test_a_long_path_is_read_in_seconds():
    """20 seconds, were each matrix looked at by itself."""
    data = content(keyframes=[frame(seconds=k) for k in range(20_000)])
    began = time.process_time()
    assert len(path_from(data, "p").keyframes) == 20_000
    assert time.process_time() - began < 5


def test_a_path_is_saved_in_its_folder_alone():
    for name in ("", "../x", ".hidden", "a\nb"):
        with pytest.raises(DevrfError, match="expected a name"):
            check_name(name)
    assert check_name("my path-2.1") == "my path-2.1"

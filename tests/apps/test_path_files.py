"""Camera paths as files: devrf's own and nerfstudio's; what is none is refused in one line."""

from __future__ import annotations

import json

import pytest
import torch

from devrf.apps.keyframes import CameraPath, Keyframe, check_name, path_from, read_path, write_path
from devrf.errors import DevrfError

# Looks along −x from (1, 2, 3), row by row.
MATRIX = [0, 0, 1, 1, 1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 0, 1]
POSE = torch.tensor(MATRIX, dtype=torch.float32).view(4, 4)[:3]


def frame(**more):
    return {"matrix": MATRIX, "fov": 50, "aspect": 1.5, "render_time": 0, "seconds": 0, **more}


def content(**keys) -> bytes:
    return json.dumps(keys).encode()


def test_what_is_saved_is_read(tmp_path):
    further = torch.cat([POSE[:, :3], torch.tensor([[4.0], [5.0], [6.0]])], dim=1)
    keyframes = (Keyframe(POSE, 50.0, 0.2, 1.0), Keyframe(further, 70.0, 0.8, 3.0))
    write_path(tmp_path / "paths" / "a.json", CameraPath(keyframes, 1.5, 4.0), 200)
    found = read_path(tmp_path / "paths" / "a.json")
    assert (found.aspect, found.fps, found.duration) == (1.5, 4.0, 2.0)
    for one, given in zip(found.keyframes, keyframes, strict=True):
        torch.testing.assert_close(one.camera_to_world, given.camera_to_world)
        assert (one.fov, one.time, one.seconds) == (given.fov, given.time, given.seconds - 1)


def test_what_is_saved_is_nerfstudios(tmp_path):
    keyframes = (Keyframe(POSE, 50.0, 0.0, 0.0), Keyframe(POSE, 50.0, 1.0, 1.0))
    write_path(tmp_path / "a.json", CameraPath(keyframes, 1.5, 4.0), 200)
    saved = json.loads((tmp_path / "a.json").read_text())
    assert (saved["render_width"], saved["render_height"], saved["seconds"]) == (300, 200, 1)
    assert saved["camera_type"] == "perspective" and len(saved["camera_path"]) == 5
    assert saved["camera_path"][1] == {
        "camera_to_world": MATRIX,
        "fov": 50.0,
        "aspect": 1.5,
        "render_time": 0.25,
    }


def test_nerfstudios_file_gives_a_keyframe_for_each_camera():
    camera = {"camera_to_world": MATRIX, "fov": 40, "aspect": 1.25}
    # As its viewer writes keyframes: without seconds; in earlier versions with a matrix in text.
    told = {"matrix": str(MATRIX), "fov": 40, "aspect": 1.25, "properties": "[]"}
    path = path_from(content(keyframes=[told], camera_path=[camera] * 3, fps=2, crop=None), "p")
    assert [one.seconds for one in path.keyframes] == [0, 0.5, 1]
    assert [one.time for one in path.keyframes] == [0, 0.5, 1]
    assert (path.aspect, path.fps, path.keyframes[0].fov) == (1.25, 2, 40)
    torch.testing.assert_close(path.keyframes[2].camera_to_world, POSE)


def test_nerfstudios_times_are_taken():
    shots = [
        {"camera_to_world": MATRIX, "fov": 40, "render_time": time} for time in (0.5, 0.5, 0.1)
    ]
    path = path_from(content(camera_path=shots), "p")
    assert [one.time for one in path.keyframes] == [0.5, 0.5, 0.1]


SCALED = [2 * value for value in MATRIX[:12]] + MATRIX[12:]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"{", "p: not valid JSON"),
        (content(fps=24), "p: holds no camera path; expected keyframes with seconds, or camera_pa"),
        (content(keyframes=[frame(fov=190)]), "p: keyframes[0].fov: "),
        (content(keyframes=[frame(), frame(render_time=2)]), "p: keyframes[1].render_time: "),
        (content(keyframes=[frame(matrix=[1, 2])]), "p: keyframes[0].matrix"),
        (content(keyframes=[frame(matrix="x")]), "p: keyframes[0].matrix: should be a valid array"),
        (content(keyframes=[frame(matrix=SCALED)]), "p: keyframes[0].matrix: is no rigid transfo"),
        (content(keyframes=[frame(), frame()]), "p: keyframes[1].seconds: expected more than 0"),
        (content(camera_type="equirectangular"), "p: camera_type: "),
        (
            content(camera_path=[{"camera_to_world": SCALED, "fov": 50}]),
            "p: camera_path[0].camera_to_world: is no rigid transform",
        ),
    ],
)
def test_what_is_no_path_is_refused_in_one_line(data, expected):
    with pytest.raises(DevrfError) as error:
        path_from(data, "p")
    assert str(error.value).startswith(expected) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a\nb", "x" * 101])
def test_a_path_is_saved_in_its_folder_alone(name):
    with pytest.raises(DevrfError, match="expected a name"):
        check_name(name)
    assert check_name("my path-2.1") == "my path-2.1"

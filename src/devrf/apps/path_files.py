"""Camera paths as JSON, which nerfstudio's viewer and renderer read, too.

nerfstudio's file has ``camera_path``, a camera for each picture: ``camera_to_world`` (4×4, row by
row, OpenGL axes), ``fov`` (vertical, degrees), ``aspect``, and ``render_time`` where the scene
moves; and ``keyframes`` from which its viewer made them (``matrix``, ``fov``, ``aspect``). devrf
adds ``seconds`` and ``render_time`` to each keyframe and goes through them itself. In a file
without these, each camera of ``camera_path`` counts as a keyframe.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from torch import Tensor

from devrf.apps.keyframes import CameraPath, Keyframe
from devrf.errors import DevrfError
from devrf.scenes.json_files import MAX_BYTES, Number, Positive, read_json
from devrf.scenes.poses import in_reach, is_rotation
from devrf.scenes.validation import first_error, scene_error
from devrf.system.files import write_json

Matrix = Annotated[list[Number], Field(min_length=16, max_length=16)]
Angle = Annotated[Number, Field(gt=0, lt=180)]
Time = Annotated[Number, Field(ge=0, le=1)]


class _PathCamera(BaseModel):
    camera_to_world: Matrix
    fov: Angle
    aspect: Positive = 1.0
    render_time: Time | None = None


class _PathKeyframe(BaseModel):
    # nerfstudio's earlier viewer wrote its matrix as text; such a keyframe is not used.
    matrix: Matrix | str | None = None
    fov: Angle | None = None
    aspect: Positive = 1.0
    render_time: Time | None = None
    seconds: Annotated[Number, Field(ge=0)] | None = None


class _PathFile(BaseModel):
    keyframes: list[_PathKeyframe] = []
    camera_path: list[_PathCamera] = []
    camera_type: Literal["perspective"] = "perspective"
    fps: Positive = 24.0


_FILE = TypeAdapter(_PathFile)


def read_path(file: Path) -> CameraPath:
    """The camera path in a file.

    Raises:
        DevrfError: there is no such file, or it is no camera path.
    """
    return _path(read_json(file, _FILE, "give video.path a file that the viewer saved"), file)


def path_from(content: bytes, name: str) -> CameraPath:
    """The camera path in the ``content`` of a file called ``name``.

    Raises:
        DevrfError: it is none.
    """
    if len(content) > MAX_BYTES:
        raise scene_error(name, f"larger than {MAX_BYTES >> 20} MiB, expected a camera path")
    try:
        return _path(_FILE.validate_json(content), name)
    except ValidationError as error:
        raise first_error(error, f"{name}: ") from None


def write_path(file: Path, path: CameraPath, height: int) -> None:
    """Write a camera path, whole or not at all; ``height`` is that of nerfstudio's pictures."""
    first, shots = path.keyframes[0].seconds, path.sampled(path.frames)
    content = {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": round(path.aspect * height),
        "fps": path.fps,
        "seconds": path.duration,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "default_fov": path.keyframes[0].fov,
        "keyframes": [
            {
                "matrix": _row_by_row(one.camera_to_world),
                "fov": one.fov,
                "aspect": path.aspect,
                "render_time": one.time,
                "seconds": one.seconds - first,
            }
            for one in path.keyframes
        ],
        "camera_path": [
            {
                "camera_to_world": _row_by_row(one.camera_to_world),
                "fov": one.fov,
                "aspect": path.aspect,
                "render_time": one.time,
            }
            for one in shots
        ],
    }
    write_json(file, content)


def _path(read: _PathFile, where: object) -> CameraPath:
    own = [one for one in read.keyframes if one.seconds is not None]
    if own and len(own) == len(read.keyframes):
        made = [_own_keyframe(one, f"{where}: keyframes[{k}]") for k, one in enumerate(own)]
        seconds = [one.seconds for one in made]
        for k in range(1, len(seconds)):
            if seconds[k] <= seconds[k - 1]:
                raise scene_error(
                    f"{where}: keyframes[{k}].seconds",
                    f"expected more than {seconds[k - 1]:g}, as before it, not {seconds[k]:g}",
                )
        return CameraPath(tuple(made), own[0].aspect, read.fps)
    shots = read.camera_path
    if not shots:
        raise scene_error(
            where, "holds no camera path; expected keyframes with seconds, or camera_path"
        )
    last = max(len(shots) - 1, 1)
    return CameraPath(
        tuple(
            Keyframe(
                _pose(one.camera_to_world, f"{where}: camera_path[{k}].camera_to_world"),
                one.fov,
                k / last if one.render_time is None else one.render_time,
                k / read.fps,
            )
            for k, one in enumerate(shots)
        ),
        shots[0].aspect,
        read.fps,
    )


def _own_keyframe(one: _PathKeyframe, where: str) -> Keyframe:
    for name in ("matrix", "fov", "render_time"):
        if getattr(one, name) is None:
            raise scene_error(f"{where}.{name}", "is missing; add it")
    assert one.fov is not None and one.render_time is not None and one.seconds is not None
    return Keyframe(_pose(one.matrix, f"{where}.matrix"), one.fov, one.render_time, one.seconds)


def _pose(numbers: list[float] | str | None, where: str) -> Tensor:
    """The camera (3, 4) in 16 numbers, row by row."""
    if not isinstance(numbers, list):
        raise scene_error(where, "expected a list of 16 numbers, row by row")
    pose = torch.tensor(numbers, dtype=torch.float64).view(4, 4)[:3]
    if not bool(is_rotation(pose[:, :3])) or not bool(in_reach(pose[:, 3])):
        raise scene_error(where, "is no rigid transform; give a rotation and a translation")
    return pose.float()


def _row_by_row(camera_to_world: Tensor) -> list[float]:
    return [*camera_to_world.flatten().tolist(), 0.0, 0.0, 0.0, 1.0]


def check_name(name: str) -> str:
    """The name of a path's file, if it is one.

    Raises:
        DevrfError: it would lie in another folder, or holds what a file's name does not.
    """
    if not name or len(name) > 100 or not all(c.isalnum() or c in "-_ ." for c in name):
        raise DevrfError(f"{name!r}: expected a name of letters, digits, '-', '_' and '.'")
    if name.startswith("."):
        raise DevrfError(f"{name!r}: expected a name that does not begin with a dot")
    return name

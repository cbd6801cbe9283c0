"""A video's path: keyframes of camera and time, the smooth way through them, and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from pydantic import BaseModel, Field, TypeAdapter, ValidationError
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.files import MAX_BYTES, Number, Positive, read_json
from devrf.scenes.validation import first_error, in_reach, is_rotation, scene_error
from devrf.system.files import write_json

# More frames than this are a mistake in the file: an hour at 25 a second.
MOST_FRAMES = 90_000


@dataclass(frozen=True)
class Keyframe:
    """A camera at one moment of a film.

    Attributes:
        camera_to_world: (3, 4) rigid, OpenGL axes, world units.
        fov: the vertical angle of view in degrees.
        time: the scene's time in [0, 1].
        seconds: when the film is there, from its beginning.
    """

    camera_to_world: Tensor
    fov: float
    time: float
    seconds: float


@dataclass(frozen=True)
class CameraPath:
    """A way through keyframes.

    Positions, angles of view and quaternions follow a cubic Hermite spline through the keyframes,
    whose slope at each is that between its neighbours (Catmull-Rom); quaternions are made unit
    ones afterwards. The scene's time goes straight from one keyframe to the next, so that it
    stands still between two of the same time.

    Attributes:
        keyframes: at least one, their seconds ascending.
        aspect: width over height of the film.
        fps: its pictures a second.
    """

    keyframes: tuple[Keyframe, ...]
    aspect: float
    fps: float

    @property
    def duration(self) -> float:
        """Seconds from the first keyframe to the last."""
        return self.keyframes[-1].seconds - self.keyframes[0].seconds

    @property
    def frames(self) -> int:
        """The pictures of the film, both ends included.

        Raises:
            DevrfError: too many.
        """
        count = round(self.duration * self.fps) + 1
        if count > MOST_FRAMES:
            raise DevrfError(
                f"the path takes {self.duration:g} s at {self.fps:g} pictures a second, expected "
                f"at most {MOST_FRAMES} pictures; lower its fps, or the seconds of its keyframes"
            )
        return count

    def at(self, moments: Tensor) -> list[Keyframe]:
        """The camera and the scene's time at ``moments`` (N,), in seconds of the film."""
        frames = self.keyframes
        knots = torch.tensor([one.seconds for one in frames], dtype=torch.float64)
        moments = moments.double().clamp(knots[0], knots[-1])
        poses = torch.stack([one.camera_to_world.double() for one in frames])
        angles = torch.tensor([[one.fov] for one in frames], dtype=torch.float64)
        known = torch.cat([poses[:, :, 3], angles, _one_side(poses[:, :, :3])], dim=1)
        seen = hermite(knots, known, moments)
        position, fov, wxyz = seen[:, :3], seen[:, 3], seen[:, 4:]
        turned = quaternion_to_rotation_matrix(torch.nn.functional.normalize(wxyz, dim=1))
        times = torch.tensor([[one.time] for one in frames], dtype=torch.float64)
        times = straight(knots, times, moments)
        path = torch.cat([turned, position[:, :, None]], dim=2)
        return [
            Keyframe(
                path[k].float(),
                min(max(float(fov[k]), 1.0), 179.0),
                min(max(float(times[k]), 0.0), 1.0),
                float(moments[k]),
            )
            for k in range(len(moments))
        ]

    def sampled(self, frames: int) -> list[Keyframe]:
        """``frames`` keyframes, evenly spread over the film."""
        first, last = self.keyframes[0].seconds, self.keyframes[-1].seconds
        return self.at(torch.linspace(first, last, frames, dtype=torch.float64))


def cameras_of(keyframes: list[Keyframe], aspect: float, height: int) -> Cameras:
    """The cameras of N keyframes, with images ``height`` pixels high."""
    width = max(1, round(aspect * height))
    focal = torch.tensor([height / 2 / math.tan(math.radians(k.fov) / 2) for k in keyframes])
    return Cameras(
        torch.stack([one.camera_to_world for one in keyframes]),
        focal[:, None].expand(-1, 2),
        torch.tensor([width / 2, height / 2]).expand(len(keyframes), 2),
        width,
        height,
    )


def keyframes_of(cameras: Cameras, times: list[float], seconds: float) -> tuple[Keyframe, ...]:
    """Keyframes at N cameras and times, evenly spread over ``seconds``."""
    angle = 2 * torch.atan(cameras.height / 2 / cameras.focal[:, 1])
    steps = max(len(cameras) - 1, 1)
    return tuple(
        Keyframe(
            cameras.camera_to_world[k],
            math.degrees(float(angle[k])),
            times[k],
            seconds * k / steps,
        )
        for k in range(len(cameras))
    )


def hermite(knots: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """The cubic Hermite spline through ``values`` (K, C) at ascending ``knots`` (K,).

    Args:
        knots: where the values are.
        values: what the spline goes through.
        at: (N,) places between the first knot and the last.

    Returns:
        (N, C).
    """
    if len(knots) == 1:
        return values.expand(len(at), -1)
    after = torch.searchsorted(knots, at, right=True).clamp(1, len(knots) - 1)
    before = after - 1
    neighbours = torch.arange(len(knots))
    low, high = (neighbours - 1).clamp(min=0), (neighbours + 1).clamp(max=len(knots) - 1)
    slope = (values[high] - values[low]) / (knots[high] - knots[low])[:, None]
    step = (knots[after] - knots[before])[:, None]
    u = (at - knots[before])[:, None] / step
    return (
        (1 + 2 * u) * (1 - u) ** 2 * values[before]
        + u * (1 - u) ** 2 * step * slope[before]
        + u**2 * (3 - 2 * u) * values[after]
        + u**2 * (u - 1) * step * slope[after]
    )


def straight(knots: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """As :func:`hermite`, on straight lines from one value to the next."""
    if len(knots) == 1:
        return values.expand(len(at), -1)
    after = torch.searchsorted(knots, at, right=True).clamp(1, len(knots) - 1)
    before = after - 1
    share = ((at - knots[before]) / (knots[after] - knots[before]))[:, None]
    return values[before] + share * (values[after] - values[before])


def _one_side(rotations: Tensor) -> Tensor:
    """Quaternions (K, 4) of rotations, each with the sign that is nearer to the one before."""
    found = rotation_matrix_to_quaternion(rotations)
    flips = (found[1:] * found[:-1]).sum(dim=1) < 0
    signs = torch.where(flips, -1.0, 1.0).to(found).cumprod(dim=0)
    return torch.cat([found[:1], found[1:] * signs[:, None]])


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

"""A video's path: keyframes of camera and time, the smooth way through them, and its file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from pydantic import BaseModel, BeforeValidator, Field, ValidationError
from torch import Tensor

from devrf.apps.camera_paths import NAMES, quaternions
from devrf.apps.video import MAX_FRAMES, Rate
from devrf.checkpoints.checkpoint import ASPECT
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.offset import NO_OFFSET, Offset, added, subtracted
from devrf.scenes.files import Number, read_json
from devrf.scenes.validation import check_poses, scene_error
from devrf.system.files import bounded, write_json
from devrf.system.options import first_error


@dataclass(frozen=True)
class Keyframe:
    """A camera at one point of a video.

    Attributes:
        camera_to_world: (3, 4) rigid, OpenGL axes, world units.
        fov: the vertical angle of view in degrees.
        time: the scene's time in [0, 1].
        seconds: from the beginning of the video.
    """

    camera_to_world: Tensor
    fov: float
    time: float
    seconds: float


@dataclass(frozen=True)
class CameraPath:
    """A way through at least one keyframe, their seconds ascending.

    Positions, angles of view and quaternions follow a cubic Hermite spline through the keyframes,
    whose slope at each is that between its neighbours (Catmull-Rom); quaternions are made unit
    ones afterwards. The scene's time goes straight from one keyframe to the next, so that it
    stands still between two of the same time. The video's ``aspect`` is width over height.
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
        """The frames of the video, both ends included.

        Raises:
            DevrfError: too many.
        """
        count = round(self.duration * self.fps) + 1
        if count > MAX_FRAMES:
            raise DevrfError(
                f"the path takes {self.duration:g} s at {self.fps:g} frames a second, expected "
                f"at most {MAX_FRAMES} frames; lower its fps, or the seconds of its keyframes"
            )
        return count

    def at(self, seconds: Tensor) -> list[Keyframe]:
        """The camera and the scene's time at ``seconds`` (N,) of the video."""
        poses = torch.stack([frame.camera_to_world.double() for frame in self.keyframes])
        rows = [[frame.seconds, frame.fov, frame.time] for frame in self.keyframes]
        knots, fovs, times = torch.tensor(rows, dtype=torch.float64).T.contiguous()
        seconds = seconds.double().clamp(knots[0], knots[-1])
        controls = torch.cat([poses[:, :, 3], fovs[:, None], quaternions(poses[:, :, :3])], dim=1)
        values = hermite(knots, controls, seconds)
        position = values[:, :3]
        fov = values[:, 3:4]
        wxyz = values[:, 4:]
        rotation = quaternion_to_rotation_matrix(wxyz)
        path = torch.cat([rotation, position[:, :, None]], dim=2).float()
        time = torch.from_numpy(np.interp(seconds, knots, times))[:, None]
        rows = torch.cat([fov.clamp(1, 179), time.clamp(0, 1), seconds[:, None]], dim=1).tolist()
        return [
            Keyframe(pose, fov=fov_now, time=time_now, seconds=second)
            for pose, (fov_now, time_now, second) in zip(path, rows, strict=True)
        ]

    def sampled(self, frames: int) -> list[Keyframe]:
        """``frames`` keyframes, evenly spread over the video."""
        first = self.keyframes[0].seconds
        last = self.keyframes[-1].seconds
        return self.at(torch.linspace(first, last, frames, dtype=torch.float64))


def cameras_of(keyframes: list[Keyframe], aspect: float, height: int) -> Cameras:
    """The cameras of N keyframes, with images ``height`` pixels high."""
    width = max(1, round(aspect * height))
    focal = torch.tensor([height / 2 / math.tan(math.radians(k.fov) / 2) for k in keyframes])
    return Cameras(
        torch.stack([keyframe.camera_to_world for keyframe in keyframes]),
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
        Keyframe(pose, math.degrees(float(angle[k])), times[k], seconds * k / steps)
        for k, pose in enumerate(cameras.camera_to_world)
    )


def hermite(knots: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """The cubic Hermite spline (N, C) through ``values`` (K, C) at ascending ``knots`` (K,).

    Evaluated ``at`` (N,) places between the first knot and the last.
    """
    if len(knots) == 1:
        return values.expand(len(at), -1)
    before = torch.searchsorted(knots, at, right=True).clamp(1, len(knots) - 1) - 1
    u = ((at - knots[before]) / (knots[before + 1] - knots[before]))[:, None]
    after = before + 1
    k = torch.arange(len(knots))
    low = (k - 1).clamp(min=0)
    high = (k + 1).clamp(max=len(knots) - 1)
    slope = (values[high] - values[low]) / (knots[high] - knots[low])[:, None]
    step = (knots[after] - knots[before])[:, None]
    return (
        (1 + 2 * u) * (1 - u) ** 2 * values[before]
        + u * (1 - u) ** 2 * step * slope[before]
        + u**2 * (3 - 2 * u) * values[after]
        + u**2 * (u - 1) * step * slope[after]
    )


def _with_seconds(keyframes: Any) -> Any:
    """devrf's own keyframes; without seconds they are nerfstudio's, which are not used."""
    has_seconds = isinstance(keyframes, list) and all(
        isinstance(keyframe, dict) and keyframe.get("seconds") is not None for keyframe in keyframes
    )
    return keyframes if has_seconds else []


Matrix = Annotated[list[Number], Field(min_length=16, max_length=16)]
Time = Annotated[Number, Field(ge=0, le=1)]


class _PathCamera(BaseModel):
    matrix: Matrix = Field(alias="camera_to_world")
    fov: Annotated[Number, Field(gt=0, lt=180)]
    aspect: Annotated[Number, Field(ge=1 / ASPECT, le=ASPECT)] = 1.0
    render_time: Time | None = None


class _PathKeyframe(_PathCamera):
    matrix: Matrix
    render_time: Time
    seconds: Annotated[Number, Field(ge=0)]


# An error of each camera would take 1 kB.
Many = Field(fail_fast=True, max_length=MAX_FRAMES)


class _PathFile(BaseModel):
    keyframes: Annotated[list[_PathKeyframe], Many, BeforeValidator(_with_seconds)] = []
    camera_path: Annotated[list[_PathCamera], Many] = []
    camera_type: Literal["perspective"] = "perspective"
    fps: Rate = 24.0


def read_path(file: Path, offset: Offset = NO_OFFSET) -> CameraPath:
    """The camera path in a file, whose positions are of the capture's world.

    ``offset`` is the scene's (:mod:`devrf.geometry.offset`), and subtracted from them.

    nerfstudio's viewer and renderer read these files, too. Its own have ``camera_path``, a camera
    for each frame: ``camera_to_world`` (4×4, row by row, OpenGL axes), ``fov`` (vertical, degrees),
    ``aspect``, and ``render_time`` where the scene moves; and ``keyframes`` from which its viewer
    made them. devrf adds ``seconds`` and ``render_time`` to each keyframe and goes through them
    itself. Each camera of ``camera_path`` counts as a keyframe in a file without these.

    Raises:
        DevrfError: there is no such file, or it is no camera path.
    """
    remedy = f"give video.path {', '.join(NAMES)}, or a file that the viewer saved"
    return _path(read_json(file, _PathFile, remedy), file, offset)


def path_from(content: bytes, name: str, offset: Offset = NO_OFFSET) -> CameraPath:
    """As :func:`read_path`, from the ``content`` of a file called ``name``."""
    try:
        return _path(_PathFile.model_validate_json(bounded(content)), name, offset)
    except ValidationError as error:
        raise first_error(error, f"{name}: ") from None
    except ValueError as error:  # its size
        raise scene_error(name, f"{error}; expected a path") from None


def write_path(file: Path, path: CameraPath, height: int, offset: Offset = NO_OFFSET) -> None:
    """Write a camera path, whole or not at all; ``height`` is that of nerfstudio's frames.

    ``offset`` is the scene's (:mod:`devrf.geometry.offset`), and added to positions.
    """

    def entry(keyframe: Keyframe, matrix: str) -> dict[str, Any]:
        pose = added(keyframe.camera_to_world, offset)
        return {
            matrix: [*pose.flatten().tolist(), 0.0, 0.0, 0.0, 1.0],
            "fov": keyframe.fov,
            "aspect": path.aspect,
            "render_time": keyframe.time,
        }

    first = path.keyframes[0].seconds
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
            {**entry(key, "matrix"), "seconds": key.seconds - first} for key in path.keyframes
        ],
        "camera_path": [entry(key, "camera_to_world") for key in path.sampled(path.frames)],
    }
    write_json(file, content)


def _path(content: _PathFile, where: object, offset: Offset) -> CameraPath:
    entry, cameras = "keyframes[{}].matrix", list[_PathCamera](content.keyframes)
    if not cameras:
        entry, cameras = "camera_path[{}].camera_to_world", content.camera_path
    last = max(len(cameras) - 1, 1)
    numbers = torch.tensor([camera.matrix for camera in cameras], dtype=torch.float64)
    poses = numbers.view(-1, 4, 4)[:, :3]
    check_poses(poses, lambda k: f"{where}: {entry.format(k)}")
    keyframes = [
        Keyframe(
            pose,
            camera.fov,
            k / last if camera.render_time is None else camera.render_time,
            camera.seconds if isinstance(camera, _PathKeyframe) else k / content.fps,
        )
        for k, (camera, pose) in enumerate(
            zip(cameras, subtracted(poses, offset).float(), strict=True)
        )
    ]
    if not keyframes:
        raise scene_error(
            where, "holds no camera path; expected keyframes with seconds, or camera_path"
        )
    for k, (before, after) in enumerate(pairwise(keyframes), 1):
        if after.seconds <= before.seconds:
            raise scene_error(
                f"{where}: keyframes[{k}].seconds",
                f"expected more than {before.seconds:g}, as before it, not {after.seconds:g}",
            )
    return CameraPath(tuple(keyframes), cameras[0].aspect, content.fps)


def check_name(name: str) -> str:
    """The name of a path's file, if it is one.

    Raises:
        DevrfError: it would lie in another folder, or holds what a file's name does not.
    """
    if not re.fullmatch(r"[\w-][\w .-]{0,99}", name):
        raise DevrfError(f"{name!r}: expected a name of letters, digits, '-', '_' and '.'")
    return name

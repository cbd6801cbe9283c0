"""``transforms_*.json``: posed images as NeRF's Blender scenes list them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from devrf.scenes.images import find_image
from devrf.scenes.validation import inside, number, problem

# Rotations are written with 5 digits or more; further off they are scaled, sheared or mirrored.
ROTATION_TOLERANCE = 1e-2
TIME_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera's inner numbers, for images of any size where an angle gives them.

    Attributes:
        angle_x: horizontal field of view in radians, or None when ``focal`` is given.
        focal: (fx, fy) in pixels of the files, or None.
        center: (cx, cy) in pixels of the files; None means the image's middle.
    """

    angle_x: float | None
    focal: tuple[float, float] | None
    center: tuple[float | None, float | None]

    def in_pixels(self, width: int, height: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """((fx, fy), (cx, cy)) for files of ``width`` × ``height`` pixels."""
        if self.focal is not None:
            focal = self.focal
        else:
            assert self.angle_x is not None  # read_transforms asks for one of the two
            square = width / 2 / math.tan(self.angle_x / 2)
            focal = (square, square)
        cx, cy = self.center
        return focal, (width / 2 if cx is None else cx, height / 2 if cy is None else cy)


@dataclass(frozen=True)
class Transforms:
    """The posed images of one split, in the order of the file.

    Attributes:
        file: the JSON file.
        intrinsics: shared by all images.
        images: N existing files inside the scene's folder.
        poses: (N, 3, 4) float32 camera-to-world, OpenGL axes, world units.
        times: N times in [0, 1], or None when the file gives none.
    """

    file: Path
    intrinsics: Intrinsics
    images: tuple[Path, ...]
    poses: Tensor
    times: tuple[float, ...] | None


def read_transforms(file: Path, root: Path) -> Transforms:
    """Read one split.

    Args:
        file: a ``transforms_*.json``; its image paths are relative to its folder.
        root: the scene's folder, which no image path may leave.

    Raises:
        DevrfError: the file is missing, is no JSON, lacks a key, holds no frames, or holds a
            value that is none (NaN poses, times outside [0, 1], a field of view of 0 …).
    """
    content = _json_object(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise problem(file, 'expected a non-empty list "frames"; add the posed images')
    images, poses, times = [], [], []
    for index, frame in enumerate(frames):
        where = f"{file}: frames[{index}]"
        if not isinstance(frame, dict):
            raise problem(where, f"expected an object, not {type(frame).__name__}; correct it")
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise problem(where, 'has no "file_path"; add the image\'s path')
        images.append(find_image(inside(root, file.parent / name, file)))
        inside(root, images[-1], file)
        poses.append(_pose(frame, where))
        times.append(_time(frame, where))
    known = [t for t in times if t is not None]
    if known and len(known) < len(times):
        raise problem(
            f"{file}: frames[{times.index(None)}]",
            'has no "time" although others have; give every frame its time, or none',
        )
    return Transforms(
        file, _intrinsics(content, file), tuple(images),
        torch.tensor(poses, dtype=torch.float32), tuple(known) or None,
    )


def _json_object(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise problem(file, "no such file; every split needs one (train and test)")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise problem(file, f"not valid JSON ({error}); write it again") from None
    if not isinstance(content, dict):
        raise problem(file, 'expected a JSON object with "frames" and "camera_angle_x"')
    return content


def _pose(frame: dict[str, Any], where: str) -> list[list[float]]:
    if "transform_matrix" not in frame:
        raise problem(where, 'has no "transform_matrix"; add the 4x4 camera-to-world matrix')
    matrix = frame["transform_matrix"]
    sized = isinstance(matrix, list) and len(matrix) in (3, 4)
    if not sized or not all(isinstance(row, list) and len(row) == 4 for row in matrix):
        raise problem(where, "transform_matrix is not 4x4 or 3x4; give camera-to-world rows")
    rows = [[number(value) for value in row] for row in matrix[:3]]
    pose = [[value for value in row if value is not None] for row in rows]
    if any(len(row) < 4 for row in pose):
        raise problem(where, "transform_matrix holds NaN, inf or text; give finite numbers")
    rotation = torch.tensor(pose, dtype=torch.float64)[:, :3]
    off = (rotation.T @ rotation - torch.eye(3, dtype=torch.float64)).abs().max()
    if float(off) > ROTATION_TOLERANCE or float(torch.linalg.det(rotation)) < 0:
        raise problem(
            where, "transform_matrix is no rigid transform (scaled, sheared or mirrored axes); "
            "give a rotation and a translation",
        )
    return pose


def _time(frame: dict[str, Any], where: str) -> float | None:
    if "time" not in frame:
        return None
    time = number(frame["time"])
    if time is None or not -TIME_TOLERANCE <= time <= 1 + TIME_TOLERANCE:
        raise problem(where, f"time is {frame['time']!r}, outside [0, 1]; rescale the times")
    return min(max(time, 0.0), 1.0)


def _intrinsics(content: dict[str, Any], file: Path) -> Intrinsics:
    def positive(key: str) -> float | None:
        if key not in content:
            return None
        value = number(content[key])
        if value is None or value <= 0:
            raise problem(file, f"{key} is {content[key]!r}, expected pixels > 0; correct it")
        return value

    center = positive("cx"), positive("cy")
    fx, fy = positive("fl_x"), positive("fl_y")
    if fx is not None:
        return Intrinsics(None, (fx, fx if fy is None else fy), center)
    if "camera_angle_x" not in content:
        raise problem(file, 'has no "camera_angle_x" (radians) and no "fl_x" (pixels); add one')
    angle = number(content["camera_angle_x"])
    if angle is None or not 0 < angle < math.pi:
        raise problem(
            file, f"camera_angle_x is {content['camera_angle_x']!r}, expected radians between 0 "
            "and pi; correct it",
        )
    return Intrinsics(angle, None, center)

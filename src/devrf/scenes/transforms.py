"""``transforms*.json``: posed images, as NeRF's Blender scenes and nerfstudio list them.

Keys that only say how the poses came to be (``applied_transform``, ``applied_scale``) are left
alone: poses and images are consistent as they are.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from devrf.scenes.image_files import find_image
from devrf.scenes.intrinsics import Intrinsics, frame_intrinsics, read_intrinsics
from devrf.scenes.json_files import json_object
from devrf.scenes.paths import inside
from devrf.scenes.poses import FARTHEST, in_reach, is_rotation
from devrf.scenes.validation import abbreviated, number, scene_error

TIME_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Transforms:
    """The posed images of one split, in the order of the file.

    Attributes:
        file: the JSON file.
        intrinsics: N, one an image; the same object where images share it.
        images: N existing files inside the scene's folder.
        poses: (N, 3, 4) float32 camera-to-world, OpenGL axes, world units.
        times: N times in [0, 1], or None when the file gives none.
        masks: N existing files inside the scene's folder, or None of an image without one; None
            where they were not asked for.
    """

    file: Path
    intrinsics: tuple[Intrinsics, ...]
    images: tuple[Path, ...]
    poses: Tensor
    times: tuple[float, ...] | None
    masks: tuple[Path | None, ...] | None = None

    def __getitem__(self, index: Sequence[int]) -> Transforms:
        """The images at the positions ``index``, at least one, in that order."""
        return Transforms(
            self.file,
            tuple(self.intrinsics[i] for i in index),
            tuple(self.images[i] for i in index),
            self.poses[list(index)],
            None if self.times is None else tuple(self.times[i] for i in index),
            None if self.masks is None else tuple(self.masks[i] for i in index),
        )


def read_transforms(file: Path, root: Path, *, masked: bool = False) -> Transforms:
    """Read one split, or one file of all images.

    Args:
        file: a ``transforms*.json``; its image paths are relative to its folder.
        root: the scene's folder, which no image path may leave.
        masked: whether ``mask_path`` is read, too.

    Raises:
        DevrfError: the file is missing, is no JSON, lacks a key, holds no frames, or holds a
            value that is none (NaN poses, times outside [0, 1], a field of view of 0 …).
    """
    content = json_object(file, "every capture needs its posed images")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise scene_error(file, 'expected a non-empty list "frames"; add the posed images')
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise scene_error(
                f"{file}: frames[{index}]",
                f"expected an object, not {type(frame).__name__}; correct it",
            )
    where = [f"{file}: frames[{index}]" for index in range(len(frames))]
    times = [_time(frame, place) for frame, place in zip(frames, where, strict=True)]
    known = [t for t in times if t is not None]
    if known and len(known) < len(times):
        raise scene_error(
            where[times.index(None)],
            'has no "time" although others have; give every frame its time, or none',
        )
    poses = _poses(frames, where)
    return Transforms(
        file,
        _intrinsics(content, frames, where, file),
        tuple(_image(frame, place, file, root) for frame, place in zip(frames, where, strict=True)),
        poses.float(),
        tuple(known) or None,
        tuple(_mask(f, place, file, root) for f, place in zip(frames, where, strict=True))
        if masked
        else None,
    )


def _intrinsics(
    content: dict[str, Any], frames: list[dict[str, Any]], where: list[str], file: Path
) -> tuple[Intrinsics, ...]:
    own = [frame_intrinsics(content, f, place) for f, place in zip(frames, where, strict=True)]
    if None not in own:
        return tuple(lens for lens in own if lens is not None)
    shared = read_intrinsics(content, file)
    return tuple(shared if lens is None else lens for lens in own)


def _image(frame: dict[str, Any], where: str, file: Path, root: Path) -> Path:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise scene_error(where, 'has no "file_path"; add the image\'s path')
    return listed_image(name, file, root)


def _mask(frame: dict[str, Any], where: str, file: Path, root: Path) -> Path | None:
    name = frame.get("mask_path")
    if name is None:
        return None
    if not isinstance(name, str) or not name:
        raise scene_error(
            where, f"mask_path is {abbreviated(name)}, expected a file's path; correct it"
        )
    path = inside(root, file.parent, name, file)
    if not os.path.isfile(path):
        raise scene_error(path, "no such mask; correct mask_path, or set data.masks=none")
    return path


def listed_image(name: str, file: Path, root: Path) -> Path:
    """The existing image inside ``root`` that ``file`` calls ``name``; else DevrfError."""
    return find_image(inside(root, file.parent, name, file))


def _poses(frames: list[dict[str, Any]], where: list[str]) -> Tensor:
    """(N, 3, 4) float64 camera-to-world."""
    rows = [_pose(frame, place) for frame, place in zip(frames, where, strict=True)]
    poses = torch.tensor(rows, dtype=torch.float64)
    for bad, what in (
        (
            ~is_rotation(poses[:, :, :3]),
            "is no rigid transform (scaled, sheared or mirrored axes); "
            "give a rotation and a translation",
        ),
        (
            ~in_reach(poses[:, :, 3]),
            f"is farther than {FARTHEST:g} from the origin; give smaller world units",
        ),
    ):
        if bool(bad.any()):
            raise scene_error(where[int(bad.nonzero()[0])], f"transform_matrix {what}")
    return poses


def _pose(frame: dict[str, Any], where: str) -> list[list[float]]:
    if "transform_matrix" not in frame:
        raise scene_error(where, 'has no "transform_matrix"; add the 4x4 camera-to-world matrix')
    matrix = frame["transform_matrix"]
    sized = isinstance(matrix, list) and len(matrix) in (3, 4)
    if not sized or not all(isinstance(row, list) and len(row) == 4 for row in matrix):
        raise scene_error(where, "transform_matrix is not 4x4 or 3x4; give camera-to-world rows")
    rows = [[number(value) for value in row] for row in matrix[:3]]
    pose = [[value for value in row if value is not None] for row in rows]
    if any(len(row) < 4 for row in pose):
        raise scene_error(where, "transform_matrix holds NaN, inf or text; give finite numbers")
    return pose


def _time(frame: dict[str, Any], where: str) -> float | None:
    if "time" not in frame:
        return None
    time = number(frame["time"])
    if time is None or not -TIME_TOLERANCE <= time <= 1 + TIME_TOLERANCE:
        raise scene_error(
            where, f"time is {abbreviated(frame['time'])}, outside [0, 1]; rescale the times"
        )
    return min(max(time, 0.0), 1.0)

"""Camera files of forward-facing captures: ``poses_bounds.npy``, ``poses.npy``, ``bds.npy``.

LLFF writes a camera's axes as columns [down, right, back]; the moving capture's are written as
[right, up, back], which are OpenGL's axes and ours.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, Field
from torch import Tensor

from devrf.geometry.poses import average_pose, relative_to
from devrf.scenes.files import Number, Numbers, Vector2, read_json, read_numbers
from devrf.scenes.lens import Intrinsics
from devrf.scenes.validation import check_poses, in_reach, scene_error

log = logging.getLogger(__name__)

# The file of LLFF's cameras, and that of NR-NeRF's, whose images are a video.
POSES = "poses_bounds.npy"
PRECOMPUTED = "precomputed.json"
# The nearest point of the scene is placed at 1/0.75 of the near plane's distance, as LLFF does.
BOUND_FACTOR = 0.75
# A camera's least depth below this share of their median counts as that of a stray point.
STRAY_SHARE = 0.5
# This share of a video's cameras may see stray points, too, at depths above that share.
STRAY_CAMERAS = 0.1


@dataclass(frozen=True)
class PosedSet:
    """N cameras as a file gives them, in double precision.

    Attributes:
        file: their file, for messages.
        poses: (N, 3, 4) camera-to-world, OpenGL axes, the unit of the file.
        intrinsics: N, in pixels of images of the size that the file states.
        bounds: (N, 2) least and largest depth of each camera's points, the unit of the file.
    """

    file: Path
    poses: Tensor
    intrinsics: tuple[Intrinsics, ...]
    bounds: Tensor

    def __len__(self) -> int:
        return self.poses.shape[0]

    def normalised(self, *, with_strays: bool) -> PosedSet:
        """The set in units of 0.75 · its least depth, its average pose the identity.

        Least depths of stray points count only ``with_strays``, as in LLFF's own unit. DevrfError
        if the cameras look in too different directions, or are too far apart.
        """
        least = self.bounds[:, 0]
        agreed = least[(least >= STRAY_SHARE * least.median()) | with_strays]
        if stray := len(least) - len(agreed):
            depths = f"the nearest depth is {float(agreed.min()):.3g}, not {float(least.min()):.3g}"
            log.info("%s: %d cameras see stray points before them: %s", self.file, stray, depths)
        scale = 1 / (BOUND_FACTOR * float(agreed.min()))
        middle = average_pose(self.poses)
        # NaN compares false.
        if (
            not float(self.poses[:, :, 2].mean(dim=0).norm()) > 0.5
            or not float(torch.linalg.det(middle[:, :3])) > 0.99
        ):
            raise scene_error(
                self.file,
                "its cameras do not face the scene from one side; use data=inward for others",
            )
        poses = relative_to(middle, self.poses, scale)
        if not bool(in_reach(poses[:, :, 3]).all()):
            raise scene_error(
                self.file, "its cameras are too far from one another; correct positions and depths"
            )
        return replace(self, poses=poses, bounds=self.bounds * scale)

    def near_plane(self) -> float:
        """Distance of the near plane from the origin, for a camera that also moves along −z.

        It is :data:`BOUND_FACTOR` of the way from the foremost position to the nearest point,
        except points of :data:`STRAY_CAMERAS` alone; at least 1, LLFF's plane in a normalised set.
        """
        position = self.poses[:, 2, 3]
        depth = self.bounds[:, 0] * self.poses[:, 2, 2] - position
        foremost = -float(position.min())
        nearest = float(depth.quantile(STRAY_CAMERAS))
        return max(1.0, foremost + BOUND_FACTOR * (nearest - foremost))


def read_static_poses(folder: Path) -> PosedSet:
    """The cameras of ``poses_bounds.npy`` (N, 17); DevrfError if it is missing or something else.

    A row is a 3×5 matrix (axes [down, right, back], position, [H, W, focal]), then least and
    largest depth.
    """
    file = folder / POSES
    rows = read_numbers(file, "the static cameras, (N, 17)")
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
        raise scene_error(file, f"has shape {rows.shape}, expected (N, 17); write it again")
    matrix = rows[:, :15].reshape(-1, 3, 5)
    down, right, *further = matrix.transpose(2, 0, 1)
    return _posed_set(file, np.stack([right, -down, *further], axis=2), file, rows[:, 15:])


Row = tuple[Number, Number, Number, Number, Number]


class _Precomputed(BaseModel):
    """``precomputed.json``, as NR-NeRF publishes it.

    Attributes:
        poses: N matrices 3×5: axes [right, up, back], position, [H, W, focal].
        bds: N times least and largest depth.
    """

    poses: Annotated[list[tuple[Row, Row, Row]], Field(fail_fast=True, min_length=1)]
    bds: Annotated[list[Vector2], Field(fail_fast=True, min_length=1)]


def read_precomputed_poses(folder: Path) -> PosedSet:
    """The cameras of NR-NeRF's ``precomputed.json``; DevrfError if it holds something else."""
    file = folder / PRECOMPUTED
    content = read_json(file, _Precomputed, "expected the cameras of a video")
    return _posed_set(file, np.array(content.poses), file, np.array(content.bds))


def read_dynamic_poses(folder: Path) -> PosedSet:
    """The cameras of ``poses.npy`` (N, 3, 5) and ``bds.npy`` (N, 2).

    A matrix holds axes [right, up, back], position, [H, W, focal]. DevrfError if a file is
    missing or holds something else.
    """
    file = folder / "poses.npy"
    depths = folder / "bds.npy"
    matrix = read_numbers(file, "the moving capture's cameras, (N, 3, 5)")
    if matrix.ndim != 3 or matrix.shape[1:] != (3, 5) or len(matrix) == 0:
        raise scene_error(file, f"has shape {matrix.shape}, expected (N, 3, 5); write it again")
    bounds = read_numbers(depths, "least and largest depths, (N, 2)")
    return _posed_set(file, matrix, depths, bounds)


def _posed_set(file: Path, matrix: Numbers, depths: Path, bounds: Numbers) -> PosedSet:
    """The set of matrices (N, 3, 5), axes [right, up, back], and the bounds in ``depths``.

    DevrfError that names the file and the row at fault.
    """
    if bounds.shape != (len(matrix), 2):
        raise scene_error(
            depths, f"has depths {bounds.shape}, expected ({len(matrix)}, 2); write it again"
        )
    for h, w, focal in matrix[:, :, 4].tolist():
        if min(h, w) < 1 or focal <= 0:
            what = f"height {h:g}, width {w:g} or focal length {focal:g} is not above 0; correct it"
            raise scene_error(file, what)
    cameras = torch.from_numpy(np.ascontiguousarray(matrix[:, :, :4]))
    check_poses(cameras, lambda row: f"{file}: camera {row}")
    ranges = torch.from_numpy(np.ascontiguousarray(bounds))
    good = (ranges[:, 0] > 0) & (ranges[:, 0] < ranges[:, 1])
    if not bool(good.all()):
        raise scene_error(
            depths,
            f"camera {int((~good).nonzero()[0])}: expected 0 < least depth < largest "
            "depth; correct it",
        )
    intrinsics = tuple(
        Intrinsics((focal, focal), (None, None), (w, h)) for h, w, focal in matrix[:, :, 4].tolist()
    )
    return PosedSet(file, cameras, intrinsics, ranges)

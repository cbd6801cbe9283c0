"""Camera files of forward-facing captures: ``poses_bounds.npy``, ``poses.npy``, ``bds.npy``.

LLFF writes a camera's axes as columns [down, right, back]; the moving capture's are written as
[right, up, back], which are OpenGL's axes and ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.poses import average_pose, relative_to
from devrf.scenes.files import Numbers, read_numbers
from devrf.scenes.lens import LEAST_FOCAL, MOST_FOCAL, MOST_OFFSET
from devrf.scenes.validation import FARTHEST, in_reach, is_rotation, scene_error

# The file of LLFF's cameras.
POSES = "poses_bounds.npy"
# Images made smaller lose a fraction of a pixel; images of another shape belong to other poses.
ASPECT_TOLERANCE = 0.05
# The nearest point of the scene comes to rest at 1/0.75 of the near plane, as the field does it.
BOUND_FACTOR = 0.75


@dataclass(frozen=True)
class PosedSet:
    """N cameras as a file gives them, in double precision.

    Attributes:
        file: where they are from, for messages.
        poses: (N, 3, 4) camera-to-world, OpenGL axes, the unit of the file.
        size: (N, 2) width and height in pixels of the images that the next two refer to.
        focal: (N, 2) fx, fy in pixels.
        center: (N, 2) cx, cy in pixels.
        bounds: (N, 2) least and largest depth of what each camera sees, the unit of the file.
    """

    file: Path
    poses: Tensor
    size: Tensor
    focal: Tensor
    center: Tensor
    bounds: Tensor

    def __len__(self) -> int:
        return self.poses.shape[0]

    @property
    def sizes(self) -> list[tuple[float, float]]:
        """N (width, height) in pixels, as in ``size``."""
        return [(width, height) for width, height in self.size.tolist()]

    def last(self, count: int) -> PosedSet:
        """The last ``count`` cameras."""
        rows = ("poses", "size", "focal", "center", "bounds")
        return replace(self, **{name: getattr(self, name)[-count:] for name in rows})

    def normalised(self) -> PosedSet:
        """The set in units of 0.75 · its least depth, its average pose the identity.

        Raises:
            DevrfError: the cameras look in such different directions that there is no average, or
                are far away from one another.
        """
        scale = 1 / (BOUND_FACTOR * float(self.bounds[:, 0].min()))
        middle = average_pose(self.poses)
        # NaN compares false.
        if (
            not float(self.poses[:, :, 2].mean(dim=0).norm()) > 0.5
            or not float(torch.linalg.det(middle[:, :3])) > 0.99
        ):
            raise scene_error(
                self.file,
                "the cameras look in different directions, expected all of them to "
                "face the scene from one side; use data=inward for cameras around a scene",
            )
        poses = relative_to(middle, self.poses)
        poses[:, :, 3] *= scale
        if not bool(in_reach(poses[:, :, 3]).all()):
            raise scene_error(
                self.file,
                f"the cameras are farther than {FARTHEST:g} times the least depth from "
                "one another; correct positions and depths",
            )
        return replace(self, poses=poses, bounds=self.bounds * scale)

    def cameras(self, width: int, height: int) -> Cameras:
        """The cameras of images of ``width`` × ``height`` pixels, in single precision.

        Raises:
            DevrfError: the images have another shape than the file says.
        """
        size = torch.tensor([width, height], dtype=self.size.dtype)
        scale = size / self.size
        if float((scale[:, 0] / scale[:, 1] - 1).abs().max()) > ASPECT_TOLERANCE:
            w, h = self.size[0].tolist()
            raise scene_error(
                self.file,
                f"the poses are for images of {w:g}x{h:g} px (width x height), but "
                f"these have {width}x{height} px, another shape; bring images or poses in line",
            )
        return Cameras(
            self.poses.float(),
            (self.focal * scale).float(),
            (self.center * scale).float(),
            width,
            height,
        )


def read_static_poses(folder: Path) -> PosedSet:
    """The cameras of ``poses_bounds.npy``: (N, 17), or (N, 14) next to ``hwf_cxcy.npy``.

    A row is a 3×5 matrix (axes [down, right, back], position, [H, W, focal]) or a 3×4 one
    without the last column, then least and largest depth. ``hwf_cxcy.npy`` holds H, W, focal;
    or H, W, focal, cx, cy; or H, W, fx, fy, cx, cy; for all images.

    Raises:
        DevrfError: a file is missing or damaged, or holds something else.
    """
    file, inner = folder / POSES, folder / "hwf_cxcy.npy"
    rows = read_numbers(file, "the static cameras, (N, 17) or (N, 14)")
    if rows.ndim != 2 or rows.shape[1] not in (14, 17) or len(rows) == 0:
        raise scene_error(
            file,
            f"has shape {rows.shape}, expected (N, 17), or (N, 14) next to "
            f"{inner.name}; write it again with LLFF's imgs2poses",
        )
    if rows.shape[1] == 17:
        matrix = rows[:, :15].reshape(-1, 3, 5)
        intrinsics, where = _of_column(matrix[:, :, 4]), file
    else:
        matrix = rows[:, :12].reshape(-1, 3, 4)
        intrinsics, where = np.tile(_shared(inner), (len(rows), 1)), inner
    down, right, back, position = (matrix[:, :, k] for k in range(4))
    poses = np.stack([right, -down, back, position], axis=2)
    return _checked(file, poses, where, intrinsics, file, rows[:, -2:])


def read_dynamic_poses(folder: Path) -> PosedSet:
    """The cameras of ``poses.npy`` (N, 3, 5) and ``bds.npy`` (N, 2).

    A matrix holds axes [right, up, back], position, [H, W, focal].

    Raises:
        DevrfError: a file is missing or damaged, or holds something else.
    """
    file, depths = folder / "poses.npy", folder / "bds.npy"
    matrix = read_numbers(file, "the moving capture's cameras, (N, 3, 5)")
    if matrix.ndim != 3 or matrix.shape[1:] != (3, 5) or len(matrix) == 0:
        raise scene_error(
            file,
            f"has shape {matrix.shape}, expected (N, 3, 5): axes [right, up, "
            "back], position and [H, W, focal]; write it again",
        )
    bounds = read_numbers(depths, "least and largest depths, (N, 2)")
    if bounds.shape != (len(matrix), 2):
        raise scene_error(
            depths,
            f"has shape {bounds.shape}, expected ({len(matrix)}, 2): a row for "
            f"each camera of {file.name}; write it again",
        )
    return _checked(file, matrix[:, :, :4], file, _of_column(matrix[:, :, 4]), depths, bounds)


def _of_column(column: Numbers) -> Numbers:
    """W, H, fx, fy, cx, cy (N, 6) of columns H, W, focal (N, 3)."""
    height, width, focal = column.T
    return np.stack([width, height, focal, focal, width / 2, height / 2], axis=1)


def _shared(file: Path) -> Numbers:
    """W, H, fx, fy, cx, cy (6,) of ``hwf_cxcy.npy``."""
    values = read_numbers(file, "H, W, focal, cx, cy next to a poses_bounds.npy of (N, 14)")
    given = values.flatten()[:7].tolist()
    if len(given) == 3:
        h, w, focal = given
        given = [h, w, focal, w / 2, h / 2]
    if len(given) == 5:
        h, w, focal, cx, cy = given
        given = [h, w, focal, focal, cx, cy]
    if len(given) != 6:
        raise scene_error(
            file,
            f"holds {values.size} numbers, expected H, W, focal, cx, cy, or H, W, "
            "fx, fy, cx, cy; write it again",
        )
    h, w, fx, fy, cx, cy = given
    return np.array([w, h, fx, fy, cx, cy])


def _checked(
    file: Path, poses: Numbers, inner: Path, intrinsics: Numbers, outer: Path, bounds: Numbers
) -> PosedSet:
    """The set, or DevrfError that names the file and the row at fault."""
    matrices = torch.from_numpy(np.ascontiguousarray(poses))
    values, depths = torch.from_numpy(intrinsics), torch.from_numpy(np.ascontiguousarray(bounds))
    size, focal, center = values[:, :2], values[:, 2:4], values[:, 4:]
    side = size.amax(dim=1, keepdim=True)
    for good, where, what in (
        (
            is_rotation(matrices[:, :, :3]),
            file,
            "its axes are no rotation (scaled, sheared, mirrored or of another convention)",
        ),
        (in_reach(matrices[:, :, 3]), file, f"it is farther than {FARTHEST:g} from the origin"),
        ((size >= 1).all(dim=1), inner, "height or width is under 1 px"),
        ((focal > 0).all(dim=1), inner, "the focal length is not above 0"),
        (
            ((focal >= LEAST_FOCAL * side) & (focal <= MOST_FOCAL * side)).all(dim=1),
            inner,
            "the focal length cannot be that of an image of this height and width",
        ),
        (
            (center.abs() <= MOST_OFFSET * side).all(dim=1),
            inner,
            "the principal point is far outside the image",
        ),
        (
            (depths[:, 0] > 0) & (depths[:, 0] < depths[:, 1]),
            outer,
            "expected 0 < least depth < largest depth",
        ),
    ):
        if not bool(good.all()):
            raise scene_error(
                where,
                f"camera {int((~good).nonzero()[0])}: {what}; correct or leave "
                "out the image and its row",
            )
    return PosedSet(file, matrices, size, focal, center, depths)

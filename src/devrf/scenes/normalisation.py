"""The world of a sparse model: its origin, axes and unit, and where in it the scene is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.geometry.poses import average_pose, relative_to
from devrf.scenes.colmap_model import SparseModel
from devrf.scenes.poses import FARTHEST, in_reach
from devrf.scenes.validation import scene_error

Corner = tuple[float, float, float]
Facing = Literal["auto", "forward", "inward"]

# Cameras that all look within so many degrees of one direction face the scene from one side.
ONE_SIDE = 45.0
# From fewer points, each counted in every image that shows it, nothing is said.
LEAST_POINTS = 50
# Of the points so many per cent on either side may be wrong.
OUTLIERS = 1.0
# In the forward-facing world, the unit that makes the nearest point's distance 1/0.75: LLFF's.
NEAREST = 1 / 0.75
# Median distance of cameras around a scene from its middle, in world units.
AROUND = 4.0


@dataclass(frozen=True)
class World:
    """The normalised scene.

    Attributes:
        poses: (N, 3, 4) float64 camera-to-world, OpenGL axes, world units.
        points: (P, 3) float64.
        space: ``ndc`` or ``contracted``.
        near: distance before which nothing is, world units.
        far: distance behind which no sparse point is, world units.
        box: low and high corner of what is looked at; None of ``ndc``, and where the cameras' axes
            meet: what all cameras see is then the better guess.
    """

    poses: Tensor
    points: Tensor
    space: Literal["ndc", "contracted"]
    near: float
    far: float
    box: tuple[Corner, Corner] | None


def normalised(model: SparseModel, facing: Facing = "auto") -> World:
    """The scene of a model in a world of its own origin, axes and unit.

    Args:
        model: cameras and points, in any world.
        facing: from where the cameras look.

    Raises:
        DevrfError: the points or the cameras do not say where the scene is.
    """
    poses, points = model.poses, torch.from_numpy(model.points)
    depths = torch.cat([model.depths(k) for k in range(len(model.images))])
    depths = depths[depths > 0]
    if len(depths) < LEAST_POINTS:
        raise scene_error(
            model.folder,
            f"its images show {len(depths)} sparse points, expected {LEAST_POINTS} or more to say "
            "where the scene is; take it with more texture in sight, or write points3D again",
        )
    near, far = (float(np.percentile(depths.numpy(), p)) for p in (OUTLIERS, 100 - OUTLIERS))
    if facing == "auto":
        facing = "forward" if widest_angle(poses) <= ONE_SIDE else "inward"
    world = (_forward if facing == "forward" else _inward)(poses, points, near, far)
    here = bool(in_reach(world.poses[:, :, 3]).all())
    if not here or not 0 < world.near < world.far <= FARTHEST:  # NaN compares false
        raise scene_error(
            model.folder,
            f"its cameras and points are no scene that cameras look {facing} at (all at one place, "
            "or far apart); run COLMAP's mapper again",
        )
    return world


def widest_angle(poses: Tensor) -> float:
    """The largest angle in degrees between a camera's axis and their mean."""
    axes = -poses[:, :, 2]
    mean = normalize(axes.sum(dim=0), dim=0)
    return float(torch.rad2deg((axes @ mean).clamp(-1, 1).acos()).max())


def _forward(poses: Tensor, points: Tensor, near: float, far: float) -> World:
    frame, scale = average_pose(poses), NEAREST / near
    return World(*_moved(poses, points, frame, scale), "ndc", 1.0, far * scale, None)


def _inward(poses: Tensor, points: Tensor, near: float, far: float) -> World:
    met = _axes_meet(poses)
    middle = points.median(dim=0).values if met is None else met
    # z up, as far as the cameras were held upright.
    up = normalize(poses[:, :, 1].sum(dim=0), dim=0)
    aside = torch.eye(3, dtype=poses.dtype)[int(up.abs().argmin())]
    right = normalize(torch.linalg.cross(aside, up), dim=0)
    frame = torch.stack([right, torch.linalg.cross(up, right), up, middle], dim=1)
    scale = AROUND / float((poses[:, :, 3] - middle).norm(dim=1).median())
    poses, points = _moved(poses, points, frame, scale)
    near, far = 0.5 * near * scale, far * scale
    if met is not None:
        # Sparse points are on floor and walls, too: in their box the thing would have a fraction of
        # the voxels.
        return World(poses, points, "contracted", near, far, None)
    # What the sparse points around the middle span, and no more than the cameras go round.
    around = points[points.norm(dim=1) < AROUND]
    if len(around) < 10:
        around = points
    low, high = (
        np.clip(np.percentile(around.numpy(), p, axis=0), -AROUND, AROUND)
        for p in (2 * OUTLIERS, 100 - 2 * OUTLIERS)
    )
    margin = 0.1 * np.maximum(high - low, 0.1 * AROUND)
    box = _corner(low - margin), _corner(high + margin)
    return World(poses, points, "contracted", near, far, box)


def _corner(values: npt.NDArray[np.float64]) -> Corner:
    x, y, z = values.tolist()
    return x, y, z


def _axes_meet(poses: Tensor) -> Tensor | None:
    """The point (3,) nearest to all axes; None where they hardly meet."""
    across = torch.eye(3, dtype=poses.dtype) - poses[:, :, 2:3] * poses[:, :, 2].unsqueeze(1)
    whole = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(whole)[0]) < 1e-2:
        return None
    found: Tensor = torch.linalg.solve(whole, (across @ poses[:, :, 3:])[..., 0].mean(dim=0))
    return found


def _moved(poses: Tensor, points: Tensor, frame: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Poses and points in the world in which ``frame`` is the identity, ``scale`` times larger."""
    turned = relative_to(frame, poses)
    turned[:, :, 3] *= scale
    return turned, (points - frame[:, 3]) @ frame[:, :3] * scale

"""Layout of a scene: its box and cameras in the world, and the upward direction."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Scene

# NDC depth at which an unbounded frustum is cut off: twice the near plane's distance. More would
# dwarf the cameras.
NDC_CUT = 0.0
# Mean square sine of the angle between x axes under which cameras stand side by side.
SIDE_BY_SIDE = 1e-3
# Cameras that look down more steeply than this (degrees) are left out of the search for gaps.
STEEP = 75.0


def box_points(scene: Scene, box: Box, shape: tuple[int, int, int]) -> Tensor:
    """A grid (X, Y, Z, 3) over a box in the fields' space, faces included, in world units.

    An NDC box is cut off before infinity; in contracted space it is the inner box.
    """
    if scene.kind == "forward":
        box = Box.of(list(box.low), [*box.high[:2], min(box.high[2], NDC_CUT)])
    points = scene.space.inner(box).grid_points(shape, scene.static.train.cameras.focal)
    return scene.space.to_world(points)


def box_middle(scene: Scene) -> Tensor:
    """The middle (3,) of the scene's box in world units (of its finite part in NDC)."""
    return box_points(scene, scene.bounds.box, (3, 3, 3))[1, 1, 1]


def common_up(cameras: Cameras) -> Tensor | None:
    """The direction (3,) most nearly at right angles to all x axes of cameras held level.

    None if they do not agree.
    """
    pose = cameras.camera_to_world.double().cpu()
    mean = pose[:, :, 1].mean(dim=0)
    spread, axes = torch.linalg.eigh(pose[:, :, 0].T @ pose[:, :, 0] / len(pose))
    side_by_side = float(spread[1]) < SIDE_BY_SIDE
    # Cameras side by side share one x axis, which leaves a circle of directions.
    up = mean if side_by_side else axes[:, 0] * torch.sign(axes[:, 0] @ mean)
    if not side_by_side and float(spread[0]) >= 0.5 * float(spread[1]):
        return None
    return None if float(up @ mean) < 0.1 else normalize(up, dim=0).float()


def horizontal_axes(up: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Unit vectors east and north (3,), at right angles to the unit vector ``up`` (3,).

    East is ``near`` (3,), or the most level world axis.
    """
    near = torch.eye(3).to(up)[int(up.abs().argmin())] if near is None else near
    east = normalize(near - (near @ up) * up, dim=0)
    return east, torch.linalg.cross(up, east)


def widest_gap(scene: Scene) -> float | None:
    """The widest angle in degrees, seen from above, in which no static camera stands.

    360 for a single direction; None if cameras look from one side or most from above, or up is
    unknown.
    """
    cameras = scene.static.train.cameras
    up = common_up(cameras) if scene.kind == "inward" else None
    if up is None:
        return None
    toward = normalize(cameras.positions - box_middle(scene), dim=1)
    toward = toward[(toward @ up).abs() < math.sin(math.radians(STEEP))]
    if len(toward) < len(cameras) / 2:
        return None
    east, north = horizontal_axes(up)
    angle = torch.atan2(toward @ north, toward @ east).sort().values
    gaps = torch.cat([angle.diff(), angle[:1] + 2 * math.pi - angle[-1:]])
    return math.degrees(float(gaps.max()))

"""Where cameras stand and look, and what is wrong with that."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from devrf.artifacts.advice import Advice, listed
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.scene import Scene, Views

# Largest gap between neighbouring static views, as seen from the box's middle, in degrees.
WIDEST_GAP = 120.0
# A view from higher than this has no side that it looks from.
STEEP = 75.0
# NDC depth at which an endless frustum is cut off: twice the near plane's distance. Behind
# that lies more world than could be drawn beside the cameras.
CUT = 0.0
# Mean square sine of the angle between x axes under which cameras stand side by side.
LEVEL = 1e-3
# Two cameras are one when their axes differ by less than this (radians, about), and their
# positions by less than this share of the distance to the scene.
SAME = 1e-4


def camera_advice(scene: Scene) -> list[Advice]:
    """Everything that the cameras alone tell."""
    return [*_held_out(scene), *_looking_away(scene), *_box_unknown(scene), *_one_side(scene)]


def box_points(scene: Scene, box: Box, shape: tuple[int, int, int]) -> Tensor:
    """A grid (X, Y, Z, 3) over a box of the scene, in world units.

    Args:
        scene: its space maps the box into the world; an NDC box is cut off before infinity.
        box: a box in the fields' space.
        shape: grid points along x, y, z; the corners sit on the box's.
    """
    if scene.kind == "forward":
        box = Box.of(list(box.low), [*box.high[:2], min(box.high[2], CUT)])
    points = box.grid_points(shape, scene.static.train.cameras.focal)
    return scene.space.to_world(points)


def box_middle(scene: Scene) -> Tensor:
    """The middle (3,) of the scene's box in world units (of its finite part in NDC)."""
    return box_points(scene, scene.bounds.box, (3, 3, 3))[1, 1, 1]


def common_up(cameras: Cameras) -> Tensor | None:
    """The direction (3,) that is up for cameras held level; None where they do not agree.

    A camera may look up or down, but its own x axis stays level: up is what is most nearly at
    right angles to all of these axes.
    """
    pose = cameras.camera_to_world.double().cpu()
    mean = pose[:, :, 1].mean(dim=0)
    spread, axes = torch.linalg.eigh(pose[:, :, 0].T @ pose[:, :, 0] / len(pose))
    # Cameras side by side have one x axis, which leaves a circle to choose from.
    up = mean if float(spread[1]) < LEVEL else axes[:, 0] * torch.sign(axes[:, 0] @ mean)
    agreed = float(spread[0]) < 0.5 * float(spread[1]) or float(spread[1]) < LEVEL
    if not agreed or float(up @ mean) < 0.1:
        return None
    return torch.nn.functional.normalize(up, dim=0).float()


def widest_gap(cameras: Cameras, middle: Tensor) -> float | None:
    """The widest angle in degrees, seen from above, in which no camera stands.

    Args:
        cameras: cameras around the scene.
        middle: (3,) what they stand around, world units.

    Returns:
        360 for a single side; None where up is not known or nearly all look from above.
    """
    up = common_up(cameras)
    if up is None:
        return None
    toward = torch.nn.functional.normalize(cameras.positions - middle, dim=1)
    toward = toward[(toward @ up).abs() < math.sin(math.radians(STEEP))]
    if len(toward) < len(cameras) / 2:
        return None
    east = torch.linalg.cross(torch.eye(3).to(up)[int(up.abs().argmin())], up)
    east = torch.nn.functional.normalize(east, dim=0)
    north = torch.linalg.cross(up, east)
    angle = torch.atan2(toward @ north, toward @ east).sort().values
    gaps = torch.cat([angle.diff(), angle[:1] + 2 * math.pi - angle[-1:]])
    return math.degrees(float(gaps.max()))


def _held_out(scene: Scene) -> list[Advice]:
    found = []
    for name in ("static", "dynamic"):
        capture = scene.static if name == "static" else scene.dynamic
        if len(capture.test) == 0:
            found.append(
                Advice(
                    f"{name} test set",
                    "holds no view, so nothing can be scored",
                    "hold out some images of the capture",
                )
            )
            continue
        twins = _twins(capture.test, capture.train, box_middle(scene))
        if twins:
            found.append(
                Advice(
                    f"{name} test set",
                    f"{listed(twins)}: the same camera and time as a training "
                    "view, so the score says how well that view was learned by heart",
                    "hold out other views",
                )
            )
    return found


def _twins(test: Views, train: Views, middle: Tensor) -> list[str]:
    """Names of the test views that have the camera and the time of a training view."""
    reach = float((train.cameras.positions - middle).norm(dim=1).mean())
    poses = train.cameras.camera_to_world
    names = []
    for k, pose in enumerate(test.cameras.camera_to_world):
        turned = (poses[:, :, :3] - pose[:, :3]).abs().amax(dim=(1, 2))
        moved = (poses[:, :, 3] - pose[:, 3]).norm(dim=1) / max(reach, 1e-9)
        later = (train.times - test.times[k]).abs()
        if bool(((turned < SAME) & (moved < SAME) & (later <= FrameClock.TOLERANCE)).any()):
            names.append(test.names[k])
    return names


def _looking_away(scene: Scene) -> list[Advice]:
    points = box_points(scene, scene.bounds.box, (9, 9, 9))
    middle, points = points[4, 4, 4], points.reshape(-1, 3)
    away, beside = [], []
    for capture in (scene.static, scene.dynamic):
        for views in (capture.train, capture.test):
            cameras = views.cameras
            size = cameras.center.new_tensor([cameras.width, cameras.height])
            for k in range(len(views)):
                _, depth = cameras.project_into(k, middle[None])
                pixel, depths = cameras.project_into(k, points)
                seen = (depths > 0) & ((pixel >= 0) & (pixel <= size)).all(dim=1)
                if float(depth) <= 0:
                    away.append(views.names[k])
                elif not bool(seen.any()):
                    beside.append(views.names[k])
    remedy = "check the pose (camera-to-world, x right, y up, looking along -z), or set data.box"
    found = []
    if away:
        found.append(Advice(listed(away), "looks away from the middle of the box", remedy))
    if beside:
        found.append(Advice(listed(beside), "does not have the box in the picture", remedy))
    return found


def _box_unknown(scene: Scene) -> list[Advice]:
    views, bounds = scene.static.train, scene.bounds
    if scene.kind != "inward" or views.has_alpha:
        return []
    try:
        guessed = box_from_cameras(views.cameras)
    except DevrfError:
        return []  # then it was given
    corners = torch.tensor([*bounds.box.low, *bounds.box.high])
    guess = torch.tensor([*guessed.low, *guessed.high])
    if float((corners - guess).abs().max()) > 1e-4 * guessed.longest:
        return []
    return [
        Advice(
            "static training set",
            "has no mattes, and the box is only what the cameras all see",
            "set data.box=[[x,y,z],[x,y,z]] around the object, or give the images mattes (RGBA)",
        )
    ]


def _one_side(scene: Scene) -> list[Advice]:
    if scene.kind != "inward":
        return []
    gap = widest_gap(scene.static.train.cameras, box_middle(scene))
    if gap is None or gap <= WIDEST_GAP:
        return []
    return [
        Advice(
            "static training set",
            f"no view from a sector of {gap:.0f} degrees, seen from above",
            "expect fog on that side, or add views there "
            "(data=forward is for scenes from one side)",
        )
    ]

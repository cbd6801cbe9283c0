"""Where a scene is, found from the cameras that look at it (world units)."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.poses import FARTHEST
from devrf.scenes.scene import Bounds, Views
from devrf.scenes.silhouettes import motion_box
from devrf.scenes.validation import scene_error

# Room for motion where nothing else is known: the published scenes use 1.05 to 2.
FALLBACK_BOUND_SCALE = 1.5
# At rest: as much as is left around the rest state where the room for motion is known.
REST_BOUND_SCALE = 1.05
STILL = "no motion: the scene is at rest"
# Mean square sine of the angle between the axes and their common direction: about 2 degrees.
NEARLY_PARALLEL = 1e-3
# A near plane inside the box's sphere would be 0 or less: stay this share of the way out.
NEAR_SHARE = 0.02
# Shortest edge of a box, as a share of its distance from the origin: in a float32 a thousand
# steps along it are still a thousand places.
LEAST_EDGE = 1e-4


def axes_meet(cameras: Cameras) -> Tensor:
    """The point (3,) nearest to all optical axes, by least squares.

    Solves Σ (I − d dᵀ) p = Σ (I − d dᵀ) o for axes through o along d.

    Raises:
        DevrfError: the axes are nearly parallel, or meet behind the cameras.
    """
    origin, axis = cameras.positions.double(), cameras.forwards.double()
    across = torch.eye(3, dtype=torch.float64) - axis[:, :, None] * axis[:, None, :]
    normal = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(normal)[0]) < NEARLY_PARALLEL:
        raise scene_error(
            "data.box",
            "the static cameras look in nearly one direction, so their axes do not "
            "say where the scene is; set data.box=[[x,y,z],[x,y,z]], data.near and data.far",
        )
    point: Tensor = torch.linalg.solve(normal, (across @ origin[:, :, None])[..., 0].mean(dim=0))
    if float(((point - origin) * axis).sum(dim=1).median()) <= 0:
        raise scene_error(
            "data.box",
            "the static cameras look away from one another, expected cameras around "
            "the scene; set data.box=[[x,y,z],[x,y,z]], data.near and data.far",
        )
    return point.float()


def axes_do_meet(cameras: Cameras) -> bool:
    """Whether :func:`axes_meet` finds a point."""
    try:
        axes_meet(cameras)
    except DevrfError:
        return False
    return True


def seen_radius(cameras: Cameras, center: Tensor) -> float:
    """Radius of the sphere around ``center`` (3,) that the median camera sees whole.

    distance · sin(half of the smaller field of view); a principal point off the middle counts
    with its nearer edge.
    """
    size = cameras.center.new_tensor([cameras.width, cameras.height])
    edge = torch.minimum(cameras.center, size - cameras.center) / cameras.focal
    half_angle = torch.atan(edge.clamp(min=1e-3)).amin(dim=1)
    distance = (cameras.positions - center).norm(dim=1)
    return float((distance * half_angle.sin()).median())


def box_from_cameras(cameras: Cameras) -> Box:
    """The cube around the point all cameras look at whose half edge is what they see of it.

    Raises:
        DevrfError: what :func:`axes_meet` raises.
    """
    center = axes_meet(cameras)
    radius = seen_radius(cameras, center)
    return resolved_box(center - radius, center + radius)


def resolved_box(low: Tensor, high: Tensor) -> Box:
    """The box between two corners (3,), world units, that a float32 can tell apart.

    Raises:
        DevrfError: it is too small for its distance from the origin, or too large.
    """
    reach = float(torch.maximum(low.abs(), high.abs()).max())
    least = max(LEAST_EDGE * reach, 1 / FARTHEST)
    # NaN compares false.
    if not (float((high - low).min()) > least and reach <= FARTHEST):
        raise scene_error(
            "data.box",
            f"the cameras say that the scene lies between {low.tolist()} and "
            f"{high.tolist()}, which single precision cannot hold; bring the scene nearer to the "
            "origin, correct its unit, or set data.box=[[x,y,z],[x,y,z]]",
        )
    return Box.of(low, high)


def box_of_frusta(cameras: Cameras, near: float, far: float) -> Box:
    """The box of all that the cameras see between two distances (world units) along their rays."""
    # Ends of rays lie on a sphere, which bulges between its corners: so fine a grid sees it.
    steps = torch.linspace(0, 1, 17).to(cameras.center)
    share = torch.cartesian_prod(steps, steps)
    pixels = share * share.new_tensor([cameras.width, cameras.height])
    camera = torch.arange(len(cameras)).repeat_interleave(len(pixels))
    rays = cameras.rays(camera, pixels.repeat(len(cameras), 1))
    ends = torch.cat([rays.origins + rays.directions * distance for distance in (near, far)])
    return resolved_box(ends.amin(dim=0), ends.amax(dim=0))


def depth_range(cameras: Cameras, box: Box) -> tuple[float, float]:
    """(near, far): distances from any of the cameras between which the box's sphere lies.

    The sphere around the box: nearest camera − half diagonal, farthest camera + half diagonal.
    """
    low, high = box.corners(cameras.positions)
    half_diagonal = float((high - low).norm()) / 2
    distance = (cameras.positions - (low + high) / 2).norm(dim=1)
    nearest, farthest = float(distance.min()), float(distance.max())
    return max(NEAR_SHARE * farthest, nearest - half_diagonal), farthest + half_diagonal


def inward_bounds(
    static: Views,
    dynamic: Views | None,
    everyone: list[Views],
    *,
    bound_scale: float | str = "auto",
    near: float | None = None,
    far: float | None = None,
    box: Box | None = None,
) -> Bounds:
    """Bounds of a scene that its cameras look in at.

    Args:
        static: training views at rest, whose cameras give the box.
        dynamic: training views in motion, whose alpha masks give the motion box; None at rest.
        everyone: all views, test included; near and far hold for all their cameras.
        bound_scale: "auto" (silhouettes where there are alpha masks, else the given box or a
            fixed scale) or a number ≥ 1.
        near: distance in world units, or None for the cameras to say.
        far: distance in world units, or None.
        box: the scene's box, or None.

    Raises:
        DevrfError: the cameras do not say where the scene is, or near ≥ far.
    """
    given = box is not None
    scale = FALLBACK_BOUND_SCALE if bound_scale == "auto" else float(bound_scale)
    box = box or box_from_cameras(static.cameras)
    motion, source = None, f"canonical box x bound scale {scale:g}"
    if dynamic is None and bound_scale == "auto":
        scale, source = REST_BOUND_SCALE, STILL
    elif dynamic is not None and bound_scale == "auto":
        motion = motion_box(dynamic, box)
        if motion is None:
            source += " (no alpha masks from two cameras at every time)"
        else:
            views, frames = len(set(dynamic.view.tolist())), len(set(dynamic.times.tolist()))
            source = f"silhouettes of {views} views x {frames} frames"
    limited = given and motion is None and bound_scale == "auto"
    if limited:
        source = "data.box (no alpha masks from two cameras at every time)"
    reach = box if motion is None else box.union(motion)
    ranges = [depth_range(views.cameras, reach) for views in everyone]
    near = min(r[0] for r in ranges) if near is None else float(near)
    far = max(r[1] for r in ranges) if far is None else float(far)
    if not 0 <= near < far <= 4 * FARTHEST:
        raise scene_error(
            "data.near, data.far",
            f"expected 0 <= near < far, not {near:g} and {far:g}; "
            "set both, in world units, or leave them null",
        )
    return Bounds(box, near, far, motion, scale, source, limited)

"""Bounds of a scene from its cameras: inward-facing (world units), forward-facing (NDC)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import Bounds, GivenBounds, Views
from devrf.scenes.silhouettes import SEARCH, content_box, motion_box
from devrf.scenes.validation import FARTHEST, scene_error

# Room for motion if nothing else is known: the published scenes use 1.05 to 2.
FALLBACK_BOUND_SCALE = 1.5
# Room around a static scene, and around the canonical state if the room for motion is known.
STATIC_BOUND_SCALE = 1.05
NO_MOTION = "no motion: the scene is at rest"
# Mean square sine of the angle between the axes and their common direction: about 2 degrees.
NEARLY_PARALLEL = 1e-3
# A near plane inside the box's sphere would be 0 or less: near is at least this share of far.
NEAR_SHARE = 0.02
# Shortest edge of a box, as a share of its distance from the origin: in a float32 a thousand
# steps along it are still a thousand places.
LEAST_EDGE = 1e-4
# The source of a box from cameras.
COMMON_VIEW = "the common view of the static cameras"
# The remedy if the cameras do not determine the scene's bounds.
GIVE = "set data.box=[[x,y,z],[x,y,z]], data.near and data.far"


def nearest_point(origins: Tensor, axes: Tensor, parallel: float) -> Tensor | None:
    """The point (3,) nearest to N lines through ``origins`` (N, 3) along unit ``axes`` (N, 3).

    It solves the least-squares problem Σ (I − d dᵀ) p = Σ (I − d dᵀ) o. None if the mean square
    sine of the angle between the axes and their common direction is below ``parallel``.
    """
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(normal)[0]) < parallel:
        return None
    point: Tensor = torch.linalg.solve(normal, (across @ origins[:, :, None])[..., 0].mean(dim=0))
    return point


# Poses seem to be of another convention if cameras look at one point when they are read in that
# way, with this cosine in the median, and less so as they are. Simulated cameras that look past
# their subject by up to 25 degrees raised no false alarm.
AT_ONE_POINT = 0.9
AT_LESS = 0.97
AT_NOTHING = 0.5
# Transposed poses come this much nearer to 1; inverted ones are this much further apart.
NEARER = 0.25
FURTHER = 3.0
# Other programs' conventions of poses: name and remedy.
OPENCV = "in OpenCV's axes (y down, z ahead): negate the second and third column of each matrix"
WORLD_TO_CAMERA = "from world to camera: invert each matrix"
BOTH = f"{WORLD_TO_CAMERA}, then negate the second and third column"
TRANSPOSED = "transposed: transpose each rotation"


def axes_meet(cameras: Cameras) -> Tensor:
    """The point (3,) nearest to all optical axes, by least squares.

    DevrfError if the axes are nearly parallel, or meet behind the cameras, or would meet only if
    the poses were of another convention.
    """
    poses = cameras.camera_to_world.double()
    point, aim = _aim(poses)
    likely = _likely_convention(poses, aim)
    if point is None:
        raise scene_error(
            "data.box", f"the static cameras look in nearly one direction; {likely}{GIVE}"
        )
    if likely or aim <= 0:
        away = "away from one another" if aim <= 0 else "at no one point"
        raise scene_error("data.box", f"the static cameras look {away}; {likely}{GIVE}")
    return point.float()


def _aim(poses: Tensor) -> tuple[Tensor | None, float]:
    """The point nearest to the axes of poses (N, 3, 4), and their cosine with its direction.

    The cosine is the cameras' median; without a point it is 0.
    """
    origin = poses[:, :, 3]
    axis = -poses[:, :, 2]
    point = nearest_point(origin, axis, NEARLY_PARALLEL)
    if point is None:
        return None, 0.0
    return point, float((normalize(point - origin, dim=1) * axis).sum(dim=1).median())


def _likely_convention(poses: Tensor, aim: float) -> str:
    """The convention of poses (N, 3, 4) by which they would look at one point, in words, or empty.

    ``aim`` is the cosine with which they look at one point as they are.
    """
    if aim > AT_LESS:
        return ""
    rotation = poses[:, :, :3].mT
    inverse = torch.cat([rotation, -rotation @ poses[:, :, 3:]], dim=2)
    transposed = torch.cat([rotation, poses[:, :, 3:]], dim=2)
    turned = poses.new_tensor([1, -1, -1, 1])
    inverted = aim < AT_NOTHING and _spread(inverse) > FURTHER * _spread(poses)
    candidates = (
        (WORLD_TO_CAMERA, inverse, inverted),
        (BOTH, inverse * turned, inverted),
        (OPENCV, poses * turned, aim <= 0),
        (TRANSPOSED, transposed, 1 - _aim(transposed)[1] < NEARER * (1 - aim)),
    )
    for words, other, possible in candidates:
        if possible and _aim(other)[1] > AT_ONE_POINT:
            return f"poses look as if they were {words}; else "
    return ""


def _spread(poses: Tensor) -> float:
    """The median distance of cameras (N, 3, 4) from their mean position."""
    positions = poses[:, :, 3]
    return float((positions - positions.mean(dim=0)).norm(dim=1).median())


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
    edge = torch.minimum(cameras.center, cameras.extents - cameras.center) / cameras.focal
    half_angle = torch.atan(edge.clamp(min=1e-3)).amin(dim=1)
    distance = (cameras.positions - center).norm(dim=1)
    return float((distance * half_angle.sin()).median())


def farthest_seen(cameras: Cameras, center: Tensor) -> float:
    """Largest distance from ``center`` (3,) that the median camera's image holds across its axis.

    distance · tan(the largest angle between its axis and the middle of an edge).
    """
    edge = torch.maximum(cameras.center, cameras.extents - cameras.center) / cameras.focal
    distance = (cameras.positions - center).norm(dim=1)
    return float((distance * edge.amax(dim=1)).median())


def _turned_to_crops(cameras: Cameras) -> Cameras:
    """The cameras, with those of crops beside their axis turned to the crop's middle.

    A turned image has the same middle, and its nearest edge lies as many degrees from it.
    """
    beside = ((cameras.center <= 0) | (cameras.center >= cameras.extents)).any(dim=1)
    if not bool(beside.any()):
        return cameras
    every = torch.arange(len(cameras))
    middle = cameras.extents / 2
    ahead = cameras.rays(every, middle).directions
    right = normalize(torch.linalg.cross(ahead, cameras.camera_to_world[:, :, 1]), dim=1)
    axes = [right, torch.linalg.cross(right, ahead), -ahead, cameras.positions]
    # The cosines with rays through the middles of the four edges.
    shares = middle.new_tensor([[0, 1], [2, 1], [1, 0], [1, 2]])
    edges = (cameras.rays(every, middle * share).directions for share in shares)
    cosine = torch.stack([(edge * ahead).sum(dim=1) for edge in edges]).amax(dim=0)
    focal = middle.amin(dim=1) / torch.tan(torch.acos(cosine.clamp(-1, 1)))
    poses = torch.where(beside[:, None, None], torch.stack(axes, dim=2), cameras.camera_to_world)
    return replace(
        cameras,
        camera_to_world=poses,
        focal=torch.where(beside[:, None], focal[:, None], cameras.focal),
        center=torch.where(beside[:, None], middle, cameras.center),
    )


def box_from_cameras(
    cameras: Cameras, half_edge: Callable[[Cameras, Tensor], float] = seen_radius
) -> Box:
    """The cube around the point that all cameras look at, of that :func:`seen_radius`."""
    cameras = _turned_to_crops(cameras)
    center = axes_meet(cameras)
    radius = half_edge(cameras, center)
    return resolved_box(center - radius, center + radius)


def resolved_box(low: Tensor, high: Tensor) -> Box:
    """The box between two corners (3,), world units, that a float32 can tell apart.

    DevrfError if it is too small for its distance from the origin, or too large.
    """
    reach = float(torch.maximum(low.abs(), high.abs()).max())
    least = max(LEAST_EDGE * reach, 1 / FARTHEST)
    # NaN compares false.
    if not (float((high - low).min()) > least and reach <= FARTHEST):
        raise scene_error(
            "data.box",
            f"the cameras say {low.tolist()} to {high.tolist()}, too small or too far away; {GIVE}",
        )
    return Box.of(low, high)


def box_of_frusta(cameras: Cameras, near: float, far: float) -> Box:
    """The box of the cameras' frusta between two distances (world units) along their rays."""
    # The ends of rays lie on a sphere, which bulges between its corners: hence the fine grid.
    steps = torch.linspace(0, 1, 17).to(cameras.center)
    share = torch.cartesian_prod(steps, steps)
    pixels = share * cameras.extents[:, None]
    camera = torch.arange(len(cameras)).repeat_interleave(len(share))
    rays = cameras.rays(camera, pixels.flatten(0, 1))
    ends = torch.cat([rays.origins + rays.directions * distance for distance in (near, far)])
    return resolved_box(ends.amin(dim=0), ends.amax(dim=0))


def depth_range(cameras: Cameras, box: Box) -> tuple[float, float]:
    """(near, far): distances from any of the cameras between which the box's sphere lies.

    The sphere around the box: nearest camera − half diagonal, farthest camera + half diagonal.
    """
    low, high = box.corners(cameras.positions)
    half_diagonal = float((high - low).norm()) / 2
    distance = (cameras.positions - (low + high) / 2).norm(dim=1)
    nearest = float(distance.min())
    farthest = float(distance.max())
    return max(NEAR_SHARE * farthest, nearest - half_diagonal), farthest + half_diagonal


def inward_bounds(
    static: Views,
    dynamic: Views | None,
    everyone: list[Views],
    given: GivenBounds,
) -> Bounds:
    """Bounds in the world of an inward-facing scene.

    Arguments and errors are those of :func:`devrf.scenes.space.inward_space`.
    """
    scale = FALLBACK_BOUND_SCALE if given.scale == "auto" else float(given.scale)
    box = area = given.box or box_from_cameras(static.cameras)
    box_source = "data.box is given" if given.box else COMMON_VIEW
    if given.box is None and static.cut_out:
        # A subject that fills wide or high images is larger than the sphere that all of them hold.
        area = box_from_cameras(static.cameras, farthest_seen)
        content = content_box(static, area.scaled(SEARCH))
        if content is not None and content.union(box) != box:
            box = box.union(content)
            box_source += ", and the silhouettes"
    motion = None
    source = f"canonical box x bound scale {scale:g}"
    if dynamic is None and given.scale == "auto":
        scale = STATIC_BOUND_SCALE
        source = NO_MOTION
    elif dynamic is not None and given.scale == "auto":
        motion = motion_box(dynamic, box.scaled(SEARCH).union(area))
        if motion is None:
            source += " (no alpha masks from two cameras at every time)"
        else:
            views = len(set(dynamic.view.tolist()))
            frames = len(set(dynamic.times.tolist()))
            source = f"silhouettes of {views} views x {frames} frames"
    limited = given.box is not None and motion is None and given.scale == "auto"
    if limited:
        source = "data.box (no alpha masks from two cameras at every time)"
    reach = box if motion is None else box.union(motion)
    ranges = [depth_range(views.cameras, reach) for views in everyone]
    nearest = min(r[0] for r in ranges)
    farthest = max(r[1] for r in ranges)
    near = nearest if given.near is None else float(given.near)
    far = farthest if given.far is None else float(given.far)
    if not 0 <= near < far <= 4 * FARTHEST:
        raise scene_error(
            "data.near, data.far",
            f"expected 0 <= near < far, not {near:g} and {far:g}; the cameras say "
            f"data.near={nearest:.3g} data.far={farthest:.3g}",
        )
    return Bounds(box, near, far, motion, scale, source, limited, given, box_source=box_source)


# Cosine of the steepest angle, about 84 degrees, to −z: beyond it the box grows without bound.
LEAST_COSINE = 0.1
# The box is at most so many times as wide as the reference camera's view: beyond it the other
# cameras are not before the same scene, and a float32 cannot tell its points apart.
WIDEST = 1e3


def reference_space(cameras: Cameras, near: float) -> NormalizedDevice:
    """NDC of a camera at the origin with the mean focal lengths of the static ``cameras``.

    Their average pose is the identity; ``near`` is the distance of the near plane, world units.
    """
    fx, fy = cameras.focal.double().mean(dim=0).tolist()
    return NormalizedDevice(cameras.width, cameras.height, (fx, fy), near)


def forward_bounds(everyone: list[Views], space: NormalizedDevice, source: str) -> Bounds:
    """The box of the cameras' frusta from the near plane to infinity, in NDC.

    Rays are straight in NDC too: ``origin`` is on the near plane (z' = −1), ``origin + direction``
    at infinity (z' = 1); hence near = 0 and far = 1. ``source`` names the source of the room for
    motion. Errors are those of :func:`box_between`.
    """
    return Bounds(box_between(everyone, space), 0.0, 1.0, None, 1.0, source)


def box_between(
    everyone: list[Views], space: NormalizedDevice, front: float = -1.0, back: float = 1.0
) -> Box:
    """The box, in NDC, of the cameras' frusta from z' = ``front`` to ``back``.

    −1 is the near plane, 1 infinity. DevrfError if a camera sees points that are not before the
    reference camera.
    """
    frusta = (frusta_in(space, views.cameras, views.names, (front, back)) for views in everyone)
    ends = torch.cat([*frusta])
    low = ends.amin(dim=0).tolist()
    high = ends.amax(dim=0).tolist()
    return Box.of([low[0], low[1], front], [high[0], high[1], back])


def frusta_in(
    space: NormalizedDevice,
    cameras: Cameras,
    names: Sequence[str],
    depths: tuple[float, float] = (-1.0, 1.0),
) -> Tensor:
    """NDC (8 · N, 3) of the rays through the corners of N images at two ``depths`` z'.

    Errors are those of :func:`box_between`, by the images' ``names``.
    """
    edge = cameras.focal.new_tensor([(0, 0), (1, 0), (0, 1), (1, 1)])
    corners = (edge * cameras.extents[:, None]).flatten(0, 1)
    image = torch.arange(len(cameras)).repeat_interleave(len(edge))
    rays = cameras.rays(image, corners)
    steep = (-rays.directions[:, 2] < LEAST_COSINE).nonzero().flatten()
    if len(steep):
        raise scene_error(
            names[int(image[steep[0]])],
            "its camera does not look along the common viewing "
            "direction, so normalised device coordinates cannot hold its view; leave the "
            "image out, or use data=inward for cameras around a scene",
        )
    device = space.rays(rays)
    ends = torch.stack([device.origins, device.origins + device.directions])
    # NaN compares false.
    away = (~(ends.abs() <= WIDEST).all(dim=-1).all(dim=0)).nonzero().flatten()
    if len(away):
        raise scene_error(
            names[int(image[away[0]])],
            "its camera is too far from the others for "
            "normalised device coordinates to hold its view; correct its position, or leave "
            "the image out",
        )
    return torch.cat([device.origins + (z + 1) / 2 * device.directions for z in depths])

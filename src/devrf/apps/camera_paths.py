"""Camera paths of videos: around the scene, before it, or through the captured cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor
from torch.nn.functional import normalize

from devrf.apps.video import VideoSettings
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.poses import average_pose
from devrf.geometry.space import Space
from devrf.pictures.images import evenly
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer, points_at_depth

# Cameras stand all around if the widest gap between two, seen from above, is at most WIDEST_GAP, or
# UNEVEN times the gap of evenly spaced ones, and no more than half a circle.
WIDEST_GAP = math.radians(60)
UNEVEN = 1.5
# The variance of cameras' own horizontals, as a share, below which their mean up counts.
LEVEL = 0.02
# Cameras that look the same way differ by less than 45 degrees.
SAME_WAY = math.sqrt(0.5)
# The way through the captured cameras passes at most MAX_STOPS of them, and is sampled at POINTS.
MAX_STOPS = 300
POINTS = 1000
# Images are in a video's order if that is at most so many times longer than a short tour. The unit
# of length is the distance from the cameras to the point that they look at.
OF_A_VIDEO = 2.0
# Tours are shortened to this length a second, with which a circle takes 4.4 seconds, but keep at
# least MIN_STOPS.
PACE = 2.0
MIN_STOPS = 6
# Motion of under so many seconds or stops is smoothed, over at most this share of the way.
SMOOTH_SECONDS = 0.3
SMOOTH_STOPS = 1.5
SMOOTH_MOST = 1 / 12

# A swing leads so far from its stop, as a share of the duration that one camera filmed.
SWING_SHARE = 0.06

# The cameras of a video, from captured ones, the point (3,) that they look at, and settings.
CapturedPath = Callable[[Cameras, Tensor, VideoSettings], Cameras]
# The cameras of a video of some settings, around a scene or before it.
Ring = Callable[[VideoSettings], Cameras]
# Cameras and as many times in [0, 1].
Shots = tuple[Cameras, list[float]]


def orbit(cameras: Cameras, target: Tensor, settings: VideoSettings) -> Cameras:
    """Cameras on a circle around ``target`` (3,), looking at it, as far from it as the captured.

    They go all around if the captured cameras did; else to and fro in the sector that those
    covered. They do so ``video.orbit_turns`` times. Without ``video.orbit_elevation`` they are as
    high as the captured ones.
    """
    offsets = cameras.positions - target
    up = upward(cameras)
    east = normalize(torch.linalg.cross(torch.eye(3)[int(up.abs().argmin())], up), dim=0)
    axes = torch.stack([east, torch.linalg.cross(up, east)])
    radius = float(offsets.norm(dim=1).mean())
    elevation = float(torch.asin(normalize(offsets, dim=1) @ up).median())
    if settings.orbit_elevation is not None:
        elevation = math.radians(settings.orbit_elevation)
    turn = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    east_and_north = offsets @ axes.T
    first, extent = sector(torch.atan2(east_and_north[:, 1], east_and_north[:, 0]))
    angle = turn if extent == 2 * math.pi else first + extent * (1 + turn.sin()) / 2
    around = torch.stack([angle.cos(), angle.sin()], dim=1) @ axes
    high, level = math.sin(elevation), math.cos(elevation)
    # Up in the images, also straight above the target, where the cameras only turn.
    upright = level * up - high * around
    return _looking(cameras, target + radius * (level * around + high * up), target, upright)


def sector(angles: Tensor) -> tuple[float, float]:
    """The first of N angles (N,), counted from their widest gap on, and the extent of all; radians.

    The extent is 2π where they lie all around.
    """
    ascending = angles.sort().values
    gaps = torch.diff(ascending, append=ascending[:1] + 2 * math.pi)
    widest = int(gaps.argmax())
    first = float(ascending[(widest + 1) % len(angles)])
    uneven = min(UNEVEN * 2 / len(angles), 1.001) * math.pi  # two opposite ones are around it
    if float(gaps[widest]) <= max(WIDEST_GAP, uneven):
        return first, 2 * math.pi
    return first, 2 * math.pi - float(gaps[widest])


def upward(cameras: Cameras) -> Tensor:
    """The direction (3,) that is up where N cameras were.

    It is perpendicular to the horizontals of their images. The mean of the cameras' own up is not
    if they look down from one side; that mean counts as far as the horizontals are parallel.
    """
    right = cameras.camera_to_world[:, :, 0]
    own = cameras.camera_to_world[:, :, 1].mean(dim=0)
    spread = right.T @ right / len(right) + LEVEL * torch.eye(3)
    return normalize(torch.linalg.solve(spread, own), dim=0)


def spiral(cameras: Cameras, target: Tensor, settings: VideoSettings) -> Cameras:
    """Cameras on a small ring among those captured that look the same way, looking at ``target``.

    If cameras look in many directions, those count that look in the most common one.
    """
    level = upward(cameras)
    alike = cameras.forwards @ cameras.forwards.T
    cameras = cameras[alike[int(alike.sum(dim=1).argmax())] > SAME_WAY]
    right, up, _, middle = average_pose(cameras.camera_to_world).unbind(dim=1)
    axes = torch.stack([right, up])
    radii = 0.9 * ((cameras.positions - middle) @ axes.T).abs().quantile(0.8, dim=0)
    turn = torch.arange(settings.frames) * (2 * math.pi * settings.orbit_turns / settings.frames)
    positions = middle + torch.stack([turn.cos(), turn.sin()], dim=1) @ (radii[:, None] * axes)
    return _looking(cameras, positions, target, level)


def captured(cameras: Cameras, target: Tensor, settings: VideoSettings) -> Cameras:
    """Cameras on a smooth way through the captured ones, at an even pace, looking as they did.

    They pass frames of a video in their order, and photographs on a short tour, which leaves some
    out if the video is too short for all. The distance to ``target`` (3,) is the unit of length.
    """
    cameras = cameras[evenly(len(cameras), MAX_STOPS)]
    reach = float((cameras.positions - target).norm(dim=1).median())
    places = torch.cat([cameras.positions / reach, cameras.forwards], dim=1).double()
    apart = torch.cdist(places, places).numpy()
    seconds = settings.frames / settings.fps
    stops = in_order(apart, PACE * seconds)
    even = torch.linspace(0, 1, POINTS, dtype=torch.float64)
    views = _resampled(_views(cameras[stops], target), places[stops], even)
    share = max(SMOOTH_SECONDS / seconds, SMOOTH_STOPS / len(stops))
    nearness = (even[:, None] - even) / min(share, SMOOTH_MOST)
    views = torch.softmax(-0.5 * nearness**2, dim=1) @ views
    # Smoothing has slowed the camera down where it turned.
    poses = _poses(views)
    passed = torch.cat([poses[:, :, 3] / reach, -poses[:, :, 2], poses[:, :, 1]], dim=1)
    frames = torch.linspace(0, 1, settings.frames, dtype=torch.float64)
    return _with_one_lens(cameras, _poses(_resampled(views, passed, frames)).float())


def quaternions(rotations: Tensor) -> Tensor:
    """Quaternions (N, 4) of rotations (N, 3, 3), each with the sign nearer to the one before."""
    turns = rotation_matrix_to_quaternion(rotations.contiguous())
    same = (turns[1:] * turns[:-1]).sum(dim=1, keepdim=True) >= 0
    return torch.cat([turns[:1], turns[1:] * (2.0 * same - 1).cumprod(dim=0)])


def _views(cameras: Cameras, target: Tensor) -> Tensor:
    """Poses of N cameras as (N, 8) numbers whose means are poses that show the same.

    They are a quaternion, the point ahead of the camera where it is nearest to ``target`` (3,), and
    its distance. Between cameras around a point, a mean is as far from it, where a mean of
    positions would cut the chord.
    """
    turns = quaternions(cameras.camera_to_world[:, :, :3])
    ahead = ((target - cameras.positions) * cameras.forwards).sum(dim=1, keepdim=True).clamp(min=0)
    return torch.cat([turns, cameras.positions + ahead * cameras.forwards, ahead], dim=1).double()


def _poses(views: Tensor) -> Tensor:
    """Camera-to-world transforms (N, 3, 4) of means of :func:`_views` (N, 8)."""
    rotation = quaternion_to_rotation_matrix(views[:, :4])
    positions = views[:, 4:7] + views[:, 7:] * rotation[:, :, 2]
    return torch.cat([rotation, positions[:, :, None]], dim=2)


def in_order(apart: np.ndarray, longest: float) -> list[int]:
    """The order in which to pass N poses, by the distances (N, N) between them.

    It is their own order, if that is a video's; else a tour, which leaves poses out if it would be
    longer than ``longest``.
    """
    order = tour(apart)
    if np.diag(apart, 1).sum() <= OF_A_VIDEO * _length(apart, order):
        return list(range(len(apart)))
    while _length(apart, order) > longest and len(order) > MIN_STOPS:
        fewer = [pose for k, pose in enumerate(order) if k % 3 != 1]
        order = [fewer[k] for k in tour(apart[np.ix_(fewer, fewer)])]
    return order


def tour(apart: np.ndarray) -> list[int]:
    """A short tour of N poses that are (N, N) apart: to the nearest next, then 2-opt.

    A pose that has no distance to any other closes the tour to a ring, which is opened there.
    """
    order = [int(apart.sum(axis=1).argmax())]
    while len(order) < len(apart):
        distances = apart[order[-1]].copy()
        distances[order] = np.inf
        order.append(int(distances.argmin()))
    ring = np.array([*order, len(apart)])
    closed = np.pad(apart.astype(float), (0, 1))
    while True:
        after = np.roll(ring, -1)
        legs = closed[ring, after]
        # The length saved by replacing two legs by two others, which reverses the way between them.
        saved = legs[:, None] + legs - closed[np.ix_(ring, ring)] - closed[np.ix_(after, after)]
        np.fill_diagonal(saved, 0.0)
        first, last = sorted(np.unravel_index(saved.argmax(), saved.shape))
        # Less than rounding could alternate for ever, and NaN saves nothing.
        if not saved[first, last] > 1e-6 * legs.sum():
            break
        ring[first + 1 : last + 1] = ring[first + 1 : last + 1][::-1].copy()
    opened: list[int] = np.roll(ring, -1 - int(ring.argmax()))[:-1].tolist()
    return opened if opened[0] <= opened[-1] else opened[::-1]


def _length(apart: np.ndarray, order: list[int]) -> float:
    return float(apart[order[:-1], order[1:]].sum())


def _resampled(values: Tensor, places: Tensor, at: Tensor) -> Tensor:
    """``values`` (N, C) at N ``places`` (N, D), as (M, C) at shares ``at`` (M,) of the path."""
    steps = (places[1:] - places[:-1]).norm(dim=1).clamp(min=1e-12)
    along = torch.cat([steps.new_zeros(1), steps.cumsum(dim=0)])
    columns = [np.interp(at * along[-1], along, column) for column in values.T]
    return torch.from_numpy(np.stack(columns, axis=1))


def _rigid(poses: Tensor) -> Tensor:
    """Camera-to-world transforms (N, 3, 4) near N means of several (N, 12)."""
    means = poses.view(-1, 3, 4)
    left, _, right = torch.linalg.svd(means[:, :, :3])
    return torch.cat([left @ right, means[:, :, 3:]], dim=2).float()


def _looking(cameras: Cameras, positions: Tensor, target: Tensor, up: Tensor) -> Cameras:
    """Cameras at ``positions`` (N, 3) with the captured ones' lens that look at ``target`` (3,).

    ``up`` is (3,) or (N, 3).
    """
    poses = Cameras.looking_at(
        positions, target.expand_as(positions), focal=1.0, width=1, height=1, up=up
    )
    return _with_one_lens(cameras, poses.camera_to_world)


def _with_one_lens(cameras: Cameras, poses: Tensor) -> Cameras:
    """Cameras at ``poses`` (N, 3, 4), all with the mean focal length of the captured ones."""
    cameras = cameras.of_commonest_size()
    focal = cameras.focal.mean().expand(len(poses), 2)
    center = focal.new_tensor([cameras.width / 2, cameras.height / 2]).expand(len(poses), 2)
    return Cameras(poses, focal, center, cameras.width, cameras.height)


# By their names in video.path.
CAMERA_PATHS: dict[str, CapturedPath] = {"orbit": orbit, "spiral": spiral, "captured": captured}


def default_path(space: Space, closed: bool = False) -> str:
    """The path that suits a scene; ``closed``: one that comes back to its start.

    In an unbounded scene it stays near the captured cameras: nothing else is known.
    """
    if isinstance(space, NormalizedDevice):
        return "spiral"
    return "orbit" if space.is_linear or closed else "captured"


def looked_at(model: Renderable, cameras: Cameras, ahead: Callable[[], float]) -> Tensor:
    """The point (3,) that captured cameras look at, world units: the middle of the scene.

    In a forward-facing scene it is the point ``ahead`` of the middle of the cameras, so far away.
    """
    if not isinstance(model.space, NormalizedDevice):
        return torch.tensor(model.space.inner(model.box).middle)
    back, position = average_pose(cameras.camera_to_world)[:, 2:].unbind(dim=1)
    return position - ahead() * back


def focus_distance(renderer: Renderer, cameras: Cameras) -> float:
    """Median depth along the optical axis, world units, of the first camera's view at rest."""
    camera = cameras.single(0).to(renderer.device)
    image = renderer.view(camera, 0, 0.0, 1.0)
    solid = (image.opacity > 0.5).nonzero()[:, 0]
    if len(solid) == 0:
        return float(cameras.positions.norm(dim=1).mean()) + 1.0
    rays = camera.image_rays(0)[solid]
    points = points_at_depth(renderer.model.space, rays, image.depth[solid])
    _, depth = camera.project_into(0, points)
    return float(depth.median())


def bullet_time(ring: Ring, stop: float, settings: VideoSettings) -> Shots:
    """Once around the scene while its time stands still at ``stop``."""
    return ring(settings), [stop] * settings.frames


def time_freeze(ring: Ring, stop: float, settings: VideoSettings) -> Shots:
    """Time runs to ``stop`` and stands still while the camera goes round; then it runs on.

    Each takes a third of the frames. The camera stays where its way ends.
    """
    before, around, after = _thirds(stop, settings.frames)
    cameras = ring(replace(settings, frames=around))
    third = len(after)
    times = [*before.tolist(), *[stop] * around, *after.tolist()]
    return cameras[[0] * third + [*range(around)] + [around - 1] * third], times


def _thirds(stop: float, frames: int) -> tuple[Tensor, int, Tensor]:
    """Times up to ``stop``, the number of frames for which time stops, and times from there."""
    third = frames // 3
    before = torch.linspace(0, stop, third + 1)[:-1]
    # From the end on: a single time is the last.
    return before, frames - 2 * third, torch.linspace(1, stop, third).flip(0)


def swing(cameras: Cameras, seen_at: Sequence[float], settings: VideoSettings) -> Shots:
    """Cameras follow one moving camera as time runs, on a smooth path.

    Time stands still at ``video.time`` for a third of the frames, and the camera goes to and fro on
    that path: nobody has seen the scene from elsewhere.

    Args:
        cameras: its poses.
        seen_at: their times, in any order.
        settings: frames a second, their number, and the time that stands still.
    """
    stop = settings.time
    before, around, after = _thirds(stop, settings.frames)
    times = torch.cat([before, torch.full((around,), stop), after])
    turn = torch.linspace(0, 2 * math.pi, around)
    there = torch.cat([before, stop + SWING_SHARE * turn.sin(), after])
    seconds = settings.frames / settings.fps
    smooth = max(SMOOTH_SECONDS / seconds, SMOOTH_STOPS / len(cameras))
    nearness = (there[:, None] - torch.tensor(seen_at)) / smooth
    poses = torch.softmax(-0.5 * nearness**2, dim=1) @ cameras.camera_to_world.flatten(1)
    return _with_one_lens(cameras, _rigid(poses.double())), times.tolist()


# Beside them, videos in which the camera moves while time stands still.
PRESETS = {"bullet_time": bullet_time, "time_freeze": time_freeze}
# The path of a monocular video's camera: :func:`swing`.
SWING = "swing"
# Values of video.path beside a file.
NAMES = (*CAMERA_PATHS, *PRESETS, SWING)

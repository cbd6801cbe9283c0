"""Free space, by the static cameras alone (docs/method.md#geometry-search)."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.scenes.bounds import box_of_frusta
from devrf.scenes.scene import Scene, Views
from devrf.scenes.silhouettes import visual_hull


def searched_box(scene: Scene, *, carve: bool) -> Box:
    """The box of the geometry search: all that the static cameras see between near and far.

    It is the authors' box, a good deal larger than the cameras' common view; so more rays meet each
    of its voxels. It is the scene's own box if that was given, is not in world space, or is
    carved (``carve``) by a visual hull.
    """
    bounds = scene.bounds
    if carve or bounds.given.box or scene.kind != "inward" or not scene.space.is_linear:
        return bounds.box
    return box_of_frusta(scene.static.train.cameras, bounds.near, bounds.far).union(bounds.box)


def possibly_occupied(
    scene: Scene,
    views: Views,
    box: Box,
    shape: tuple[int, int, int],
    *,
    carve: bool,
    min_views: int = 1,
    device: torch.device | None = None,
) -> Tensor:
    """The mask (X, Y, Z) on the host of points over ``box`` that may be occupied at rest.

    Points nearer to a camera of ``views`` than its near plane are free, and points that fewer than
    ``min_views`` of them see, if there are so many: fog would explain their images. ``carve`` frees
    all outside the visual hull, if the images have alpha masks and all show the rest state, and the
    box is not unbounded. The mask is computed on ``device``; None: on the host.
    """
    space = scene.space
    cameras = views.cameras if device is None else views.cameras.to(device)
    possible = torch.ones(shape, dtype=torch.bool, device=device)
    points = space.to_world(box.grid_points(shape, cameras.focal))
    positions, near = views.cameras.positions, scene.bounds.near
    places = space.from_world(positions)
    for position in positions[(box.nearest(places) - places).norm(dim=1) < near]:
        possible &= (points - position.to(points)).norm(dim=-1) > near
    if 1 < min_views <= len(positions):
        possible &= view_count(cameras, points) >= min_views
    at_rest = float(views.times.max() - views.times.min()) <= FrameClock.TOLERANCE
    if carve and space.is_linear and views.has_alpha and at_rest:
        possible &= visual_hull(views, box, shape, device)
    return possible.cpu()


def view_count(cameras: Cameras, points: Tensor) -> Tensor:
    """The number (X, Y, Z) of cameras that see each point (X, Y, Z, 3), in world units."""
    flat = points.view(-1, 3)
    seen = torch.zeros(len(flat), device=flat.device)
    for k in range(len(cameras)):
        pixel, depth = cameras.project_into(k, flat)
        x, y = pixel.unbind(-1)
        width, height = cameras.size_of(k)
        seen += (depth > 0) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    return seen.view(points.shape[:-1])


def view_count_weight(cameras: Cameras, points: Tensor) -> Tensor:
    """The share (X, Y, Z) in (0, 1] of the cameras that see each point (X, Y, Z, 3).

    It is relative to the best-seen point; a point that no camera sees gets the share of one camera.
    """
    seen = view_count(cameras, points)
    return seen.clamp(min=1) / seen.max().clamp(min=1)

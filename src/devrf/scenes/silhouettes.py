"""Visual hulls of alpha masks: the box of everything that moves, and a grid of one state.

A hull from a few views holds the object and more: the box is an outer bound.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.scenes.scene import Views

# NumPy for the carving: hundreds of small steps, which torch's threads only slow down.
Array = npt.NDArray[Any]

OUTSIDE = 0
INSIDE = 1
UNSEEN = 2
# A pixel belongs to the silhouette when at least half of it is covered.
ALPHA_THRESHOLD = 127


# What moves is searched in so many times the box of the static scene.
SEARCH = 1.5


def motion_box(views: Views, area: Box, *, resolution: int = 64) -> Box | None:
    """The box of the union over all frames of the visual hulls.

    A point belongs to a frame's hull when at least two views see it inside their silhouettes
    and none rules it out. A view rules out points that it sees beside its silhouette, and points
    beyond its image if the silhouette keeps clear of the image's border: then nothing is cut
    off. (A second object that is out of one view while the first is whole in it is missed.)

    Args:
        views: the dynamic training views.
        area: the searched box, world units.
        resolution: grid points along each of its edges.

    Returns:
        The box in world units, a grid cell wider than the hulls on each side and not larger
        than the searched box; None without alpha masks, with fewer than two different cameras at
        some time, or when all hulls are empty.
    """
    frames = _frames(views)
    return None if frames is None else _box_of_hulls(views, frames, area, resolution)


def content_box(views: Views, area: Box, *, resolution: int = 64) -> Box | None:
    """The box of the visual hull of alpha masks of one state, as :func:`motion_box` defines it.

    Arguments and result are those of :func:`motion_box`; ``views`` all show that state.
    """
    return _box_of_hulls(views, [[*range(len(views))]], area, resolution)


def _box_of_hulls(views: Views, frames: list[list[int]], area: Box, resolution: int) -> Box | None:
    """The box, within the area, of the union of the hulls of frames, each some of the views."""
    cell = area.longest / (resolution - 1)
    points = area.grid_points((resolution,) * 3, views.cameras.focal).reshape(-1, 3)
    low, high = area.corners(views.cameras.positions)
    distance = float((views.cameras.positions - (low + high) / 2).norm(dim=1).median())
    reach = _reach(views, cell, distance, float(views.cameras.focal.amax()))
    masks = [_silhouette(view, reach, ALPHA_THRESHOLD) for view in views.singles()]
    cached: dict[tuple[int, tuple[int, int]], Array] = {}
    hull = np.zeros(len(points), dtype=np.bool_)
    for images in frames:
        # Only points that are not yet in the union are tested; each view leaves fewer of them.
        open_points = np.flatnonzero(~hull)
        inside_views = np.zeros(len(open_points), dtype=np.int64)
        for image in images:
            if len(frames) == 1:  # no projection is used twice
                pixels = _pixels_in(views.cameras.single(image), points[open_points])
            else:
                key = (int(views.view[image]), views.cameras.size_of(image))
                if key not in cached:
                    if len(cached) >= 16:  # nor is it where cameras move
                        cached.clear()
                    cached[key] = _pixels_in(views.cameras.single(image), points)
                pixels = cached[key][open_points]
            verdict = masks[image][pixels]
            keep = verdict != OUTSIDE
            open_points = open_points[keep]
            inside_views = inside_views[keep] + (verdict[keep] == INSIDE)
        hull[open_points[inside_views >= 2]] = True
    if not hull.any():
        return None
    held = points[torch.from_numpy(hull).to(points.device)]
    low = held.amin(dim=0) - cell
    high = held.amax(dim=0) + cell
    return Box.of(low, high).clipped(area)


def _frames(views: Views) -> list[list[int]] | None:
    """The images of each time; None when alpha masks or a second camera are missing."""
    if not views.has_alpha or len(views.times) == 0 or float(views.times.max()) == 0:
        return None
    clock = FrameClock.from_times(views.times)
    frame_of = clock.frames_of(views.times)
    frames = [(frame_of == k).nonzero()[:, 0].tolist() for k in sorted(set(frame_of.tolist()))]
    if any(len({int(views.view[i]) for i in images}) < 2 for images in frames):
        return None
    return frames


def _reach(views: Views, cell: float, distance: float, focal: float) -> int:
    """Pixels that half a grid cell's diagonal covers at a distance, all in world units.

    Silhouettes are dilated by them: else the grid's points could miss a part thinner than a cell.
    """
    pixels = math.sqrt(3) / 2 * cell * focal / max(distance, cell)
    return max(1, min(math.ceil(pixels), max(views.width, views.height)))


def _silhouette(view: Views, reach: int, threshold: int) -> Array:
    """Codes (H·W + 1,) uint8: pixels are INSIDE or OUTSIDE the dilated silhouette of an image.

    It is of alpha above ``threshold``. Pixels that are not valid, and those as near to them, are
    UNSEEN. The last entry is for all points beyond the image: OUTSIDE, or UNSEEN if the image's
    border cuts off the silhouette or the whole object.
    """
    solid = view.pixels[0, ..., 3].cpu().numpy() > threshold
    valid = view.valid_mask_of(0)
    unknown = np.zeros_like(solid) if valid is None else ~valid.numpy()
    solid &= ~unknown
    perhaps = solid | unknown
    cut_off = perhaps[[0, -1]].any() or perhaps[:, [0, -1]].any() or not solid.any()
    square = np.ones((2 * reach + 1,) * 2, dtype=np.uint8)
    grown, near_unknown = (cv2.dilate(m.astype(np.uint8), square) > 0 for m in (solid, unknown))
    codes = np.select([unknown, grown, near_unknown], [UNSEEN, INSIDE, UNSEEN], OUTSIDE).ravel()
    return np.append(codes, UNSEEN if cut_off else OUTSIDE).astype(np.uint8)


def _pixels_in(camera: Cameras, points: Tensor) -> Array:
    """:func:`_pixel_index` of ``points`` (P, 3), world units, in one camera."""
    projected = camera.project(torch.zeros_like(points[:, 0], dtype=torch.long), points)
    return _pixel_index(projected, camera).cpu().numpy()


def _pixel_index(projected: tuple[Tensor, Tensor], camera: Cameras) -> Tensor:
    """(P,) the pixel of each projected point in the flattened image; H·W for points beyond it."""
    pixels, depth = projected
    width, height = camera.width, camera.height
    column, row = pixels.floor().long().unbind(-1)
    held = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return torch.where(held, row * width + column, width * height)


def visual_hull(
    views: Views,
    box: Box,
    shape: tuple[int, int, int],
    device: torch.device | None = None,
    *,
    whole_in_view: bool = False,
) -> Tensor:
    """The visual hull (X, Y, Z) bool of one state of the scene, on a grid.

    A grid point is outside if any view that has it in the picture has no alpha mask within half a
    grid cell of it; so the hull holds everything, and more where no view looks, or where its pixels
    are not valid.

    Args:
        views: images with alpha masks that all show the same state.
        box: the grid's, world units; its corners are the box's corners.
        shape: grid points along x, y, z.
        device: the device of the work, one image after another; None: that of the views.
        whole_in_view: whether an image whose silhouette keeps clear of its border shows the whole
            scene, as for :func:`motion_box`.
    """
    cameras = views.cameras if device is None else views.cameras.to(device)
    points = box.grid_points(shape, cameras.focal).reshape(-1, 3)
    cell = max(edge / (n - 1) for edge, n in zip(box.size, shape, strict=True))
    held = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for k in range(len(views)):
        open_points = held.nonzero()[:, 0]
        position = views.cameras.positions[k]
        nearest = float((position - box.nearest(position)).norm())
        view = views.single(k)
        reach = _reach(views, cell, nearest, float(view.cameras.focal.max()))
        codes = _silhouette(view, reach, threshold=0)
        codes[-1] = codes[-1] if whole_in_view else UNSEEN
        outside = torch.from_numpy(codes == OUTSIDE).to(points.device)
        projected = cameras.project_into(k, points[open_points])
        held[open_points[outside[_pixel_index(projected, view.cameras)]]] = False
    return held.view(shape)

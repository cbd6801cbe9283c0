"""The captured cameras as frusta in a scene: their number, depth and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import torch
from torch import Tensor

from devrf.apps.camera_paths import looked_at
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.evaluation.held_out import truth_image
from devrf.geometry.cameras import Cameras
from devrf.pictures.images import evenly, scaled, to_bytes
from devrf.rendering.renderable import Renderable
from devrf.scenes.bounds import nearest_point
from devrf.scenes.scene import Scene, Views
from devrf.system.files import atomic_folder
from devrf.system.progress import followed

# The most frusta of a capture.
MAX_FRUSTA = 60
# The most times of which a camera's pictures are kept.
MAX_TIMES = 60
# A frustum is as deep as its neighbour is far, within these shares of the distance to the scene.
MIN_DEPTH = 0.03
MAX_DEPTH = 0.12
# Rows of an image in a frustum.
ROWS = 96


def distance_ahead(cameras: Cameras) -> float:
    """The distance from N cameras to the point that lies nearest to all their optical axes.

    Axes that meet nowhere give the cameras' extent.
    """
    origins = cameras.positions
    forwards = cameras.forwards
    extent = float((origins - origins.mean(dim=0)).norm(dim=1).max()) or 1.0
    point = nearest_point(origins, forwards, parallel=1e-3)
    ahead = 0.0 if point is None else float(((point - origins) * forwards).sum(dim=1).mean())
    return ahead if ahead > 0 else extent


def frustum_depth(cameras: Cameras) -> float:
    """The depth of the drawn frusta of N cameras, in world units."""
    positions = cameras.positions[evenly(len(cameras), MAX_FRUSTA)]
    apart = torch.cdist(positions, positions).fill_diagonal_(math.inf).amin(dim=1).median()
    away = distance_ahead(cameras)
    return float(apart.clamp(MIN_DEPTH * away, MAX_DEPTH * away))


def named_cameras(viewpoints: Viewpoints) -> dict[str, Cameras]:
    """The cameras of the training images by name, each place of the dynamic ones once."""
    captures = {"static": viewpoints.static, "dynamic": viewpoints.dynamic}
    return {
        f"{name}_{k}": cameras.single(k)
        for name, cameras in captures.items()
        for k in range(len(cameras))
    }


def thumbnail(scene: Scene, views: Views, index: int) -> Tensor:
    """The image ``index`` of views as a frustum shows it: (H', W', 3) uint8 on the host."""
    image = truth_image(views, index, scene.background)
    return to_bytes(scaled(image, min(len(image), ROWS)))


def described(model: Renderable, viewpoints: Viewpoints) -> Iterator[dict[str, Any]]:
    """The captured cameras in plain numbers, for a page: first those that saw the scene move.

    Each has its ``name``, that of its pictures' folder; ``pose``, camera to world, 12 numbers, row
    by row; ``fov``, its vertical angle of view in radians, were the principal point in the middle;
    ``middle``, the image's middle relative to it, to the right and up, in tangents of angles;
    ``aspect``, width over height; ``distance`` of its subject, world units; ``times`` of
    frames that it may have seen, :data:`MAX_TIMES` at most.
    """
    target = looked_at(model, viewpoints.static, lambda: distance_ahead(viewpoints.static))
    for kind, k, times in _shown(viewpoints):
        camera = (viewpoints.dynamic if kind == "dynamic" else viewpoints.static).single(k)
        fx, fy = camera.focal[0].tolist()
        cx, cy = camera.center[0].tolist()
        way = target - camera.positions[0]
        yield {
            "name": f"{kind}_{k}",
            "pose": camera.camera_to_world.flatten().tolist(),
            "fov": 2 * math.atan(camera.height / 2 / fy),
            "middle": [(camera.width / 2 - cx) / fx, (cy - camera.height / 2) / fy],
            "aspect": (camera.width / fx) / (camera.height / fy),
            "distance": max(float(way @ camera.forwards[0]), 0.1 * float(way.norm())),
            "times": times,
        }


def write_thumbnails(folder: Path, scene: Scene, viewpoints: Viewpoints) -> None:
    """Write the pictures of the cameras of :func:`described`: ``<name>/<index of the time>.jpg``.

    The whole folder, or nothing; one that was there is replaced.
    """
    cameras = list(_shown(viewpoints))
    with atomic_folder(folder) as whole:
        for kind, k, times in followed(cameras, len(cameras), "pictures of the cameras"):
            own = whole / f"{kind}_{k}"
            own.mkdir(parents=True)
            views = scene.static.train
            images = torch.tensor([k])
            if kind == "dynamic":
                views = scene.dynamic.train
                images = (views.view == torch.unique(views.view)[k]).nonzero()[:, 0]
            for index, time in enumerate(times):
                nearest = images[(views.times[images] - time).abs().argmin()]
                picture = thumbnail(scene, views, int(nearest)).numpy()
                iio.imwrite(own / f"{index}.jpg", picture, quality=90)


def _shown(viewpoints: Viewpoints) -> Iterator[tuple[str, int, Sequence[float]]]:
    """The cameras of a page: ``dynamic`` or ``static``, their numbers there, and their times."""
    times = viewpoints.clock.times
    some_times = [times[frame] for frame in evenly(len(times), MAX_TIMES)]
    for k in evenly(len(viewpoints.dynamic), MAX_FRUSTA):
        yield "dynamic", k, viewpoints.followed[k : k + 1] or some_times
    for k in evenly(len(viewpoints.static), MAX_FRUSTA):
        yield "static", k, [0.0]

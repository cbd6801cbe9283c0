"""Coloured points of a scene at one time, from pictures of it: for any method."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer

# Cameras that look at the scene, at most.
CAMERAS = 24
# Rows of the images that tell how much of them is filled, and of the largest ones.
FIRST, LARGEST = 24, 2048
# So many more pixels than the share that is filled asks for.
SPARE = 1.3
# What lets more light through shows no surface.
SOLID = 0.5


@dataclass(frozen=True)
class PointCloud:
    """Coloured points.

    Attributes:
        points: (N, 3) in the capture's world.
        colors: (N, 3) RGB in [0, 1], sRGB.
    """

    points: Tensor
    colors: Tensor


def seen_points(
    renderer: Renderer, cameras: Cameras, time: float, background: float, count: int
) -> PointCloud:
    """What the cameras see at ``time``: the points where their rays end, in the mean.

    Args:
        renderer: of a learned scene.
        cameras: world units; of many some, evenly chosen.
        time: in [0, 1].
        background: grey level.
        count: of points, at most; of more some, evenly chosen.
    """
    some = cameras[_evenly(len(cameras), CAMERAS)].to(renderer.device)
    filled = len(_seen(renderer, some.of_height(FIRST), time, background).points)
    rows = FIRST * (SPARE * count / max(filled, 1)) ** 0.5
    seen = _seen(renderer, some.of_height(min(round(rows), LARGEST)), time, background)
    kept = _evenly(len(seen.points), count)
    return PointCloud(seen.points[kept], seen.colors[kept])


def _seen(renderer: Renderer, cameras: Cameras, time: float, background: float) -> PointCloud:
    """The points that all pixels of the cameras show."""
    space, points, colors = renderer.model.space, [], []
    for camera in range(len(cameras)):
        rays = cameras.image_rays(camera)
        image = renderer.picture(rays, time, background)
        solid = (image.opacity > SOLID).nonzero()[:, 0]
        ends = space.rays(rays).at(solid, image.depth[solid])
        points.append(space.to_world(ends).float().cpu())
        colors.append(image.color[solid].clamp(0, 1).float().cpu())
    return PointCloud(torch.cat(points), torch.cat(colors))


def _evenly(count: int, most: int) -> Tensor:
    """Positions of at most ``most`` of ``count`` things, evenly spread."""
    if count <= most:
        return torch.arange(count)
    return torch.arange(most) * count // most

"""Points of a learned scene that cameras see, and how large the scene is by these."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.motion import radius
from devrf.metrics.geometric import SOLID
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer, points_at_depth

# Cameras that look at the scene, at most.
CAMERAS = 24
# Rows of the first images, which give the share of filled pixels.
FIRST = 24
# Rows of the largest images.
LARGEST = 2048
# The images have so many times the pixels that are expected to suffice.
SPARE = 1.3


def seen_points(
    renderer: Renderer, cameras: Cameras, time: float, background: float, count: int
) -> tuple[Tensor, Tensor]:
    """Points (N, 3) that the cameras see at ``time``, world units, and their sRGB colours (N, 3).

    Each is at the mean depth of a ray. At most :data:`CAMERAS` cameras (world units) and ``count``
    points are taken, evenly chosen. ``background`` is a grey level.
    """
    cameras = cameras[_every(len(cameras), CAMERAS)].to(renderer.device)
    filled = len(_seen(renderer, cameras, FIRST, time, background)[0])
    rows = min(round(FIRST * (SPARE * count / max(filled, 1)) ** 0.5), LARGEST)
    points, colors = _seen(renderer, cameras, rows, time, background)
    subset = _every(len(points), count)
    return points[subset], colors[subset]


def scene_radius(model: Renderable, cameras: Cameras) -> float:
    """The radius of what the cameras (world units) see at rest, world units."""
    cameras = cameras[_every(len(cameras), CAMERAS)].to(model.device)
    return radius(_seen(Renderer(model), cameras, FIRST, 0.0, 0.0)[0])


def _every(count: int, max_count: int) -> Tensor:
    """At most ``max_count`` of ``count`` positions; on a ring the last is as far from the first."""
    size = min(count, max_count)
    return torch.arange(size) * count // max(size, 1)


def _seen(
    renderer: Renderer, cameras: Cameras, rows: int, time: float, background: float
) -> tuple[Tensor, Tensor]:
    """As :func:`seen_points`, of all pixels of images ``rows`` high."""
    points = []
    colors = []
    for camera in range(len(cameras)):
        shown = cameras.single(camera).of_height(rows)
        image = renderer.view(shown, 0, time, background)
        solid = (image.opacity > SOLID).nonzero()[:, 0]
        rays = shown.image_rays(0)[solid]
        ends = points_at_depth(renderer.model.space, rays, image.depth[solid])
        points.append(ends.float().cpu())
        colors.append(image.color[solid].clamp(0, 1).float().cpu())
    return torch.cat(points), torch.cat(colors)

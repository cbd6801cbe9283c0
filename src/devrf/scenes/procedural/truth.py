"""What is known exactly about a procedural scene: where it is, and how each point moves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural.shape import BoundedShape, Shape
from devrf.scenes.scene import OpticalFlow, Views

# Motion is sampled at this many times; the margin covers what happens between them.
_TIMES = 97
_MARGIN = 0.04


@dataclass(frozen=True)
class Extent:
    """Where a shape is.

    Attributes:
        rest: a cube about the origin that holds the shape at rest.
        motion: holds the shape at all times in [0, 1].
        reach: radius of a ball about the origin that does so too, world units.
    """

    rest: Box
    motion: Box
    reach: float


def extent(shape: BoundedShape) -> Extent:
    """Where ``shape`` is, from the paths of the points around its parts."""
    outline = shape.outline()
    times = torch.linspace(0, 1, _TIMES).tolist()
    paths = torch.stack([shape.forward(outline, time) for time in times])
    half = float(outline.rest.abs().max()) + _MARGIN
    points = paths.reshape(-1, 3)
    return Extent(
        rest=Box.of([-half] * 3, [half] * 3),
        motion=Box.of(points.amin(dim=0) - _MARGIN, points.amax(dim=0) + _MARGIN),
        reach=float(points.norm(dim=-1).max()) + _MARGIN,
    )


def moved(shape: Shape, points: Tensor, time: float, to: float) -> Tensor:
    """Where the material of surface ``points`` (M, 3) at ``time`` is at time ``to``: (M, 3)."""
    return shape.forward(shape.material(points, time), to)


def backward_flow(
    shape: Shape, cameras: Cameras, depth: Tensor, time: float, earlier: float
) -> OpticalFlow:
    """Exact optical flow of N fixed cameras from ``time`` to ``earlier``.

    The point that the ray through a pixel's centre meets is carried to the earlier time and
    projected; it may be hidden there, or outside of the image.

    Args:
        shape: what is seen.
        cameras: N cameras, world units.
        depth: (N, H, W) distance along the rays through the pixels' centres, +inf on a miss.
        time: of the images.
        earlier: of the images before them.

    Returns:
        flow in pixels, 0 where nothing is seen, and valid wherever something is.
    """
    valid = depth.isfinite()
    camera, row, column = valid.nonzero().unbind(-1)
    pixels = torch.stack([column, row], dim=-1).to(depth) + 0.5
    rays = cameras.rays(camera, pixels)
    points = rays.at(torch.arange(len(rays)), depth[valid])
    before, _ = cameras.project(camera, moved(shape, points, time, earlier))
    flow = depth.new_zeros(*depth.shape, 2)
    flow[valid] = before - pixels
    return OpticalFlow(flow, valid)


def forward_flow(shape: Shape, views: Views) -> OpticalFlow:
    """Exact forward optical flow of the images of fixed cameras; the last frame's has none.

    Args:
        shape: what is seen.
        views: N images of a scene, all cameras at each of its frames, with depth.
    """
    assert views.depth is not None
    times = torch.unique(views.times)
    vectors = views.depth.new_zeros(*views.depth.shape, 2)
    valid = torch.zeros_like(views.depth, dtype=torch.bool)
    for time, later in zip(times, times[1:], strict=False):
        at = (views.times == time).nonzero()[:, 0]
        flow = backward_flow(shape, views.cameras[at], views.depth[at], float(time), float(later))
        vectors[at], valid[at] = flow.vectors, flow.valid
    return OpticalFlow(vectors, valid)

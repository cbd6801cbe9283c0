"""Pictures of a shape: shaded, antialiased RGBA and the exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural.march import CHUNK, MAX_STEPS, block_starts, trace
from devrf.scenes.procedural.shape import Shape

# Towards the lamp, world space: fixed, so that shading changes as the shape turns.
_LAMP = (0.40, -0.55, 0.73)
# Half the span over which a normal is measured, world units: well above float32 rounding.
_NORMAL_STEP = 1e-3


@dataclass(frozen=True)
class Pictures:
    """N images of a shape at one time.

    Attributes:
        pixels: (N, H, W, 4) uint8 RGBA, alpha not premultiplied.
        depth: (N, H, W) float32 distance along the ray through each pixel's centre, world
            units, +inf where it meets nothing.
    """

    pixels: Tensor
    depth: Tensor


def render(
    shape: Shape,
    cameras: Cameras,
    time: float,
    *,
    reach: float,
    supersample: int = 2,
    light: float = 0.2,
    steps: int = MAX_STEPS,
) -> Pictures:
    """The shape at ``time`` as N ``cameras`` see it.

    Args:
        shape: what to draw.
        cameras: N cameras outside of the shape.
        time: in [0, 1].
        reach: radius of a ball about the origin that holds the shape at ``time``.
        supersample: n: colour and alpha are the mean of n × n rays a pixel.
        light: share of the lamp in the lighting, 0 (albedo alone) … 1.
        steps: after how many steps a ray counts as a miss.
    """
    start = block_starts(shape, cameras, time, reach)
    size = start.shape
    start = start.reshape(-1)
    depth, image = torch.full_like(start, torch.inf), start.new_zeros(len(start), 4)
    grid, offsets = cameras.pixel_grid(), _subpixels(supersample)
    count = len(offsets)
    live = start.isfinite().nonzero().squeeze(-1)
    for pixel in torch.split(live, max(CHUNK // count, 1)):
        camera, center = pixel // len(grid), grid[pixel % len(grid)]
        depth[pixel] = trace(shape, cameras.rays(camera, center), time, start[pixel], reach, steps)
        rays = cameras.rays(
            camera.repeat_interleave(count), (center[:, None] + offsets).reshape(-1, 2)
        )
        onset = start[pixel].repeat_interleave(count)
        distance = trace(shape, rays, time, onset, reach, steps)
        hit = distance.isfinite().nonzero().squeeze(-1)
        # Colour times alpha, and alpha: only these may be averaged.
        samples = start.new_zeros(len(rays), 4)
        samples[hit, 3] = 1
        samples[hit, :3] = _shaded(shape, rays.at(hit, distance[hit]), time, light)
        mean = samples.view(-1, count, 4).mean(dim=1)
        image[pixel] = torch.cat([mean[:, :3] / mean[:, 3:].clamp_min(1e-6), mean[:, 3:]], dim=-1)
    pixels = (image * 255).round().clamp(0, 255).to(torch.uint8)
    return Pictures(pixels.view(*size, 4), depth.view(size))


def _subpixels(supersample: int) -> Tensor:
    """(n², 2) offsets from a pixel's centre to the centres of its n × n parts."""
    steps = (torch.arange(supersample) + 0.5) / supersample - 0.5
    return torch.cartesian_prod(steps, steps)


def _shaded(shape: Shape, points: Tensor, time: float, light: float) -> Tensor:
    """Colour (M, 3) of surface points: albedo, ambient light, and a wrapped diffuse lamp."""
    albedo = shape.color(shape.material(points, time))
    if light == 0:
        return albedo
    lamp = torch.nn.functional.normalize(points.new_tensor(_LAMP), dim=0)
    # Wrapped: the side away from the lamp still varies, and no edge of shadow is drawn.
    lit = 0.5 + 0.5 * (_normals(shape, points, time) @ lamp)
    return albedo * (1 - light + light * lit)[:, None]


def _normals(shape: Shape, points: Tensor, time: float) -> Tensor:
    """Unit normals (M, 3): the distance's gradient from its values at a tetrahedron's corners."""
    corners = points.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    around = (points + _NORMAL_STEP * corners[:, None]).reshape(-1, 3)
    values = shape.distance(around, time).view(4, -1)
    return torch.nn.functional.normalize(values.T @ corners, dim=-1)

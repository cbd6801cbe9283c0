"""Points that are followed through time by a learned scene's field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.motion import moving
from devrf.metrics.geometric import SOLID
from devrf.ops.splatting import rotations
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer, points_at_depth
from devrf.rendering.view import ImageView

# Steps by which a backward warp is inverted.
STEPS = 30
# Points whose nearest Gaussians are found at once.
CHUNK = 1024


@torch.no_grad()
def track(model: Renderable, points: Tensor, time: float, times: Sequence[float]) -> Tensor | None:
    """Where ``points`` (M, 3) at ``time`` are at T ``times``: (T, M, 3), all in world units.

    They go to the canonical state and from there by the method's warps (``backward_warp``,
    ``forward_warp``). Of a method that knows the backward warp alone, the point that it leads there
    is found as a fixed point. In a scene of Gaussians a point goes with the nearest one. None: the
    method has none of these.
    """
    nearest = _with_gaussians(model, points, time, times)
    backward = model.backward_warp(time)
    if nearest is not None or backward is None:
        return nearest
    canonical = backward(model.space.from_world(points))
    places = []
    for moment in times:
        forward = model.forward_warp(moment)
        if forward is None:
            at_moment = model.backward_warp(moment)
            assert at_moment is not None
            forward = partial(_inverse, at_moment)
        places.append(model.space.to_world(forward(canonical)))
    return torch.stack(places)


def shown_points(
    renderer: Renderer, camera: Cameras, pixels: Tensor, time: float
) -> tuple[Tensor, Tensor]:
    """World points (K, 3) that ``pixels`` (K, 2) of one camera show at ``time``; opacities (K,).

    A point is at the mean depth of its ray. They are on the scene's device. A method that renders
    whole images has one depth for all places in a pixel.
    """
    rays = camera.rays(torch.zeros(len(pixels), dtype=torch.long), pixels)
    if isinstance(renderer.at(time), ImageView):
        image = renderer.view(camera, 0, time, 0.0)
        limits = pixels.new_tensor([camera.width - 1, camera.height - 1])
        column, row = pixels.clamp(min=0).minimum(limits).long().unbind(1)
        at = (row * camera.width + column).to(renderer.device)
        depth, opacity = image.depth[at], image.opacity[at]
    else:
        picture = renderer.picture(rays, time, 0.0)
        depth, opacity = picture.depth, picture.opacity
    return points_at_depth(renderer.model.space, rays.to(renderer.device), depth), opacity


@torch.no_grad()
def moving_pixels(
    renderer: Renderer, camera: Cameras, time: float, times: Sequence[float], size: float
) -> Tensor | None:
    """Mask (H, W) of the pixels of a camera's picture at ``time`` that show what moves.

    A pixel shows the point at the mean depth of its ray, if more than half of that is stopped. The
    point moves, or not, over the ``times``, first at rest, in a scene of radius ``size``. None: the
    method follows no points.
    """
    points, opacity = shown_points(renderer, camera, camera.pixel_grid(), time)
    mask = opacity > SOLID
    places = track(renderer.model, points[mask], time, times)
    if places is None:
        return None
    return mask.masked_scatter(mask, moving(places, size)).view(camera.height, camera.width).cpu()


def _inverse(backward: Callable[[Tensor], Tensor], canonical: Tensor) -> Tensor:
    """Points (M, 3) that ``backward`` leads as near as can be to ``canonical`` (M, 3)."""
    best = place = canonical
    least = torch.full_like(place[:, 0], torch.inf)
    for _ in range(STEPS):
        miss = canonical - backward(place)
        error = miss.norm(dim=1)
        best = torch.where((error < least)[:, None], place, best)
        least = torch.minimum(least, error)
        place = place + miss
    return best


def _with_gaussians(
    model: Renderable, points: Tensor, time: float, times: Sequence[float]
) -> Tensor | None:
    """As :func:`track`, each point at its place in the axes of the Gaussian nearest to it."""
    now = model.gaussians_at(time)
    if now is None:
        return None
    parts = torch.split(points, CHUNK)
    nearest = torch.cat([torch.cdist(part, now.means).argmin(dim=1) for part in parts])
    axes = rotations(now.quaternions[nearest])
    local = ((points - now.means[nearest])[:, None] @ axes)[:, 0]
    places = []
    for moment in times:
        then = model.gaussians_at(moment)
        assert then is not None
        turned = (rotations(then.quaternions[nearest]) @ local[..., None])[..., 0]
        places.append(then.means[nearest] + turned)
    return torch.stack(places)

"""The optical flow that a learned scene implies in a held-out view, against the true one."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.data.batch import pixel_positions
from devrf.data.correspondence import previous_images
from devrf.methods.devrf.motion_losses import induced_flow
from devrf.methods.devrf.renderer import Renderer
from devrf.methods.devrf.volume_rendering import render
from devrf.metrics.geometric import SOLID, end_point_error
from devrf.ops.compositing import sum_by_ray
from devrf.scenes.scene import Views


def flow_error(player: Renderer, views: Views, index: int) -> float | None:
    """Mean end-point error in pixels of image ``index``'s backward flow, where that is known.

    None of a view without flow, or without an earlier frame.
    """
    if views.flow is None:
        return None
    before = int(previous_images(views)[index])
    flat = views.flow.valid[index].flatten().nonzero()[:, 0]
    if before == index or len(flat) == 0:
        return None
    seen = seen_flow(player, views, index, before, flat)
    return end_point_error(seen, views.flow.vectors[index].view(-1, 2)[flat])


@torch.no_grad()
def seen_flow(
    player: Renderer, views: Views, index: int, before: int, flat: Tensor, chunk: int = 16384
) -> Tensor:
    """The backward flow (P, 2) in pixels that is seen at some pixels of an image.

    Each sample of a pixel's ray goes to canonical space, from there to where it was at the
    earlier image's time, and onto that image. What it moves by is averaged over the ray with
    the rendering weights. Where less than half of a ray is stopped nothing is seen to move: the
    flow is zero there.

    Args:
        player: shows the learned scene.
        views: the views, on the host.
        index: the image.
        before: the same view's image one frame earlier.
        flat: (P,) row-major numbers of the pixels.
        chunk: rays rendered at once.
    """
    model, device = player.model, player.device
    time, earlier = float(views.times[index]), float(views.times[before])
    pixels = pixel_positions(flat, views.width)
    rays = views.cameras.rays(torch.full_like(flat, index), pixels).to(device)
    rays, pixels = model.space.rays(rays), pixels.to(device)
    cameras = views.cameras[[before]].to(device)
    ready, motion = player.ready(time), model.deformation
    black = torch.zeros(3, device=device)

    def unwarp(points: Tensor) -> Tensor:
        return points if motion is None else motion.unwarp(points, earlier)

    parts = []
    for k in range(0, len(rays), chunk):
        part = rays[k : k + chunk]
        output = render(part, model.canonical, ready.occupancy, model.settings, black, ready.warp)
        ray, weight = output.samples.ray, output.weight
        own = pixels[k : k + chunk][ray]
        moved = induced_flow(
            output.canonical, unwarp, cameras, torch.zeros_like(ray), own, model.space
        )
        mass = sum_by_ray(weight, ray, len(part))[:, None]
        mean = sum_by_ray(weight[:, None] * moved, ray, len(part)) / mass.clamp(min=SOLID)
        parts.append(torch.where(mass > SOLID, mean, torch.zeros_like(mean)))
    return torch.cat(parts).cpu()

"""The optical flow that a learned scene implies in a held-out view, against the truth."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.data.batch import pixel_positions
from devrf.data.correspondence import previous_images
from devrf.metrics.geometric import SOLID, end_point_error
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import MovingView
from devrf.scenes.scene import Views


def flow_error(renderer: Renderer, views: Views, index: int) -> float | None:
    """Mean end-point error in pixels of image ``index``'s backward flow, where that is known.

    None without flow or an earlier frame, or if the method's views have no motion.
    """
    if views.flow is None:
        return None
    before = int(previous_images(views)[index])
    flat = views.flow.valid[index].flatten().nonzero()[:, 0]
    if before == index or len(flat) == 0:
        return None
    seen = seen_flow(renderer, views, index, before, flat)
    if seen is None:
        return None
    return end_point_error(seen, views.flow.vectors[index].view(-1, 2)[flat])


@torch.no_grad()
def seen_flow(
    renderer: Renderer, views: Views, index: int, before: int, flat: Tensor, chunk: int = 16384
) -> Tensor | None:
    """The backward flow (P, 2) in pixels at some pixels of an image; 0 where opacity is below 0.5.

    Args:
        renderer: of the learned scene.
        views: the views, on the host.
        index: the image.
        before: the same view's image one frame earlier.
        flat: (P,) row-major numbers of the pixels.
        chunk: rays rendered at once.

    Returns:
        None if the method's views have no motion.
    """
    view = renderer.at(float(views.times[index]))
    if not isinstance(view, MovingView):
        return None
    device, earlier = renderer.device, float(views.times[before])
    pixels = pixel_positions(flat, views.width)
    rays = views.cameras.rays(torch.full_like(flat, index), pixels).to(device)
    rays, pixels = renderer.model.space.rays(rays), pixels.to(device)
    camera = views.cameras[[before]].to(device)
    parts = []
    for k in range(0, len(rays), chunk):
        some = slice(k, k + chunk)
        mean, mass = view.induced_flow(rays[some], pixels[some], camera, earlier)
        parts.append(torch.where(mass[:, None] > SOLID, mean, torch.zeros_like(mean)))
    return torch.cat(parts).cpu()

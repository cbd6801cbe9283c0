"""Which pixels are worth learning from: those whose rays meet matter."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.model import SceneModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import hits

# Rays are followed through blocks of so many pixels a side.
BLOCK = 2


@torch.no_grad()
def rays_hit_occupied(
    cameras: Cameras, image: int, model: SceneModel, occupancy: Occupancy
) -> Tensor:
    """Mask (H·W,): the pixels of an image whose rays pass near anything occupied.

    One ray stands for a block of pixels, at a quarter of the cost: what is near it is told
    generously enough (:meth:`~devrf.rendering.occupancy.Occupancy.near`) for its neighbours too.

    Args:
        cameras: all cameras, on the model's device.
        image: which of them.
        model: gives box, space, near and far.
        occupancy: where something may be at the time of the image.
    """
    width, height = (-(-size // BLOCK) for size in (cameras.width, cameras.height))
    coarse = cameras.resized(width, height)
    hit = hits(
        model.space.rays(coarse.image_rays(image)),
        model.canonical.box,
        occupancy,
        near=model.settings.near,
        far=model.settings.far,
    )
    rows = hit.view(height, width).repeat_interleave(BLOCK, dim=0)[: cameras.height]
    return rows.repeat_interleave(BLOCK, dim=1)[:, : cameras.width].reshape(-1)

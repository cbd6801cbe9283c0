"""Which pixels batches are drawn from: all, or those whose rays hit something occupied."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, all_pixels, wanted_pixels
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import hits
from devrf.scenes.scene import Views

# Rays are followed through blocks of so many pixels a side.
BLOCK = 2


@torch.no_grad()
def rays_hit_occupied(
    cameras: Cameras, image: int, model: DeVRFModel, occupancy: Occupancy
) -> Tensor:
    """Mask (H·W,): the pixels of an image whose rays pass near anything occupied.

    One ray stands for a block of pixels, at a quarter of the cost:
    :meth:`~devrf.rendering.occupancy.Occupancy.near` reaches far enough for its neighbours too.

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


def canonical_pool(views: Views, model: DeVRFModel, *, everywhere: bool) -> PixelPool:
    """The static training images' pixels: ``everywhere``, or those that hit something occupied."""
    device = model.device
    images = torch.arange(len(views), device=device)
    if everywhere:
        return all_pixels(views, images)
    cameras = views.cameras.to(device)
    hit = [rays_hit_occupied(cameras, k, model, model.occupancy) for k in range(len(views))]
    return wanted_pixels(views, images, torch.stack(hit))


@torch.no_grad()
def frame_pools(
    views: Views,
    frame: int,
    model: DeVRFModel,
    occupancy: Occupancy,
    *,
    occupied_only: bool,
    join_views: bool,
) -> list[PixelPool]:
    """The pixels to learn a frame from: pools that batches are drawn from in turn.

    Args:
        views: the dynamic training views, on the model's device.
        frame: the frame.
        model: gives box, space, near and far.
        occupancy: where something is at the frame's time.
        occupied_only: only pixels on the matte, or whose rays hit something occupied.
        join_views: one pool of all views; else one pool a view.

    Raises:
        DevrfError: no image shows the frame.
    """
    images = images_of(views, frame)
    if len(images) == 0:
        raise DevrfError(f"dynamic training set: no image at frame {frame}")
    pools = [
        _occupied(views, image, model, occupancy)
        if occupied_only
        else all_pixels(views, image[None])
        for image in images
    ]
    if not join_views:
        return pools
    image, flat = ([getattr(pool, name) for pool in pools] for name in ("image", "flat"))
    return [PixelPool(torch.cat(image), torch.cat(flat))]


def images_of(views: Views, frame: int) -> Tensor:
    """The images (K,) int64 of a frame, ascending."""
    assert views.frames is not None
    return (views.frames == frame).nonzero()[:, 0]


def _occupied(views: Views, image: Tensor, model: DeVRFModel, occupancy: Occupancy) -> PixelPool:
    """Pixels on the matte, or whose rays hit something occupied; all if there are none."""
    wanted = rays_hit_occupied(views.cameras, int(image), model, occupancy)
    if views.has_alpha:
        wanted |= views.pixels[image, :, :, 3].flatten() > 0
    pool = wanted_pixels(views, image[None], wanted[None])
    return pool if len(pool) else all_pixels(views, image[None])

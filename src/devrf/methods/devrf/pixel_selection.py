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
# Images whose rays are made together: on a CPU what its caches hold, on a GPU what keeps it busy.
ON_CPU, ON_GPU = 1, 16


@torch.no_grad()
def rays_hit_occupied(
    cameras: Cameras, images: Tensor, model: DeVRFModel, occupancy: Occupancy
) -> Tensor:
    """Mask (K, H·W): the pixels of images whose rays pass near anything occupied.

    One ray stands for a block of pixels, at a quarter of the cost:
    :meth:`~devrf.rendering.occupancy.Occupancy.near` reaches far enough for its neighbours too.

    Args:
        cameras: all cameras, on the model's device.
        images: (K,) int64, which of them.
        model: gives box, space, near and far.
        occupancy: where something may be at the time of the images.
    """
    width, height = (-(-size // BLOCK) for size in (cameras.width, cameras.height))
    coarse = cameras.resized(width, height)
    pixels, found = coarse.pixel_grid(), []
    together = ON_GPU if images.is_cuda else ON_CPU
    for start in range(0, len(images), together):
        some = images[start : start + together]
        rays = coarse.rays(some.repeat_interleave(len(pixels)), pixels.repeat(len(some), 1))
        hit = hits(
            model.space.rays(rays),
            model.canonical.box,
            occupancy,
            near=model.settings.near,
            far=model.settings.far,
        )
        rows = hit.view(-1, height, width).repeat_interleave(BLOCK, dim=1)[:, : cameras.height]
        found.append(rows.repeat_interleave(BLOCK, dim=2)[:, :, : cameras.width].flatten(1))
    return torch.cat(found)


def canonical_pool(views: Views, model: DeVRFModel, *, everywhere: bool) -> PixelPool:
    """The static training images' pixels: ``everywhere``, or those that hit something occupied."""
    device = model.device
    images = torch.arange(len(views), device=device)
    if everywhere:
        return all_pixels(views, images)
    hit = rays_hit_occupied(views.cameras.to(device), images, model, model.occupancy)
    return wanted_pixels(views, images, hit)


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
    if occupied_only:
        pools = _occupied(views, images, model, occupancy)
    else:
        pools = [all_pixels(views, image[None]) for image in images]
    if not join_views:
        return pools
    return [PixelPool(torch.cat([pool.pixels for pool in pools], dim=1))]


def images_of(views: Views, frame: int) -> Tensor:
    """The images (K,) int64 of a frame, ascending."""
    assert views.frames is not None
    return (views.frames == frame).nonzero()[:, 0]


def _occupied(
    views: Views, images: Tensor, model: DeVRFModel, occupancy: Occupancy
) -> list[PixelPool]:
    """Each image's pixels on the matte, or whose rays hit something occupied; all if none do."""
    wanted = rays_hit_occupied(views.cameras, images, model, occupancy)
    if views.has_alpha:
        wanted |= views.pixels[images][..., 3].flatten(1) > 0
    pools = []
    for image, mask in zip(images, wanted, strict=True):
        pool = wanted_pixels(views, image[None], mask[None])
        pools.append(pool if len(pool) else all_pixels(views, image[None]))
    return pools

"""The pixels of a stage's images that are worth drawing: their rays meet occupied space."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, all_pixels, wanted_pixels
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import WorldSpace
from devrf.kernels.march import march
from devrf.ops.march import MarchInputs, MarchRange
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderable import Renderable
from devrf.scenes.scene import Views

# One ray is followed for a block of so many pixels a side: at least, and at most.
BLOCK = 2
MOST_BLOCK = 8
# Images whose rays are made together: a CPU's caches hold them, and a GPU is kept busy.
IMAGES_ON_CPU = 1
IMAGES_ON_GPU = 16
# A ray hits cells that are at most so many cells away from it.
HIT_CELLS = 2
# The fewest pixels of a batch, however few pixels there are.
FEWEST = 64


@torch.no_grad()
def rays_hit_occupied(
    cameras: Cameras, images: Tensor, model: Renderable, occupancy: Occupancy
) -> Tensor:
    """Mask (K, H·W): the pixels of images whose rays pass near anything occupied.

    One ray stands for a block of pixels (:func:`block_size`).

    Args:
        cameras: all cameras, on the model's device.
        images: (K,) int64, their numbers.
        model: gives box, space, near and far.
        occupancy: an upper bound at the time of the images.
    """
    block = block_size(cameras, model, occupancy)
    width = -(-cameras.width // block)
    height = -(-cameras.height // block)
    coarse = Cameras(
        cameras.camera_to_world, cameras.focal / block, cameras.center / block, width, height
    )
    pixels = coarse.pixel_grid()
    near, far = model.depth_limits
    masks = []
    together = IMAGES_ON_GPU if images.is_cuda else IMAGES_ON_CPU
    for start in range(0, len(images), together):
        some = images[start : start + together]
        rays = coarse.rays(some.repeat_interleave(len(pixels)), pixels.repeat(len(some), 1))
        field_rays = model.space.rays(rays)
        limits = MarchRange(
            box=model.box,
            distances=occupancy.distances,
            step=occupancy.cell / max(field_rays.pace, 1e-9),
            near=near,
            far=far,
        )
        hit = rays_that_hit(field_rays, limits)
        rows = hit.view(-1, height, width).repeat_interleave(block, dim=1)[:, : cameras.height]
        masks.append(rows.repeat_interleave(block, dim=2)[:, :, : cameras.width].flatten(1))
    return torch.cat(masks)


@torch.no_grad()
def rays_that_hit(rays: Rays, limits: MarchRange) -> Tensor:
    """Mask (R,): which rays have a sample at most ``HIT_CELLS`` cells away from an occupied one."""
    distances = limits.distances
    cells = distances.cells.clamp(min=HIT_CELLS) - HIT_CELLS
    near = replace(limits, distances=replace(distances, cells=cells))
    # If all is opaque a ray ends at its first sample.
    wall = cells.new_full((2, 2, 2, 1), 100, dtype=rays.origins.dtype)
    samples = march(rays, MarchInputs(near, density=wall, shift=0.0, delta=1.0, threshold=0.5))
    return samples.transmittance < 0.5


def block_size(cameras: Cameras, model: Renderable, occupancy: Occupancy) -> int:
    """Pixels a side of a block all of whose rays are within a cell of its middle one.

    A ray that passes near anything stands for its neighbours. A block at the silhouette of the box
    is lost if something reaches the box's faces and the block's middle ray passes beside it.
    """
    if not isinstance(model.space, WorldSpace):
        return BLOCK
    low, high = model.box.corners(cameras.positions)
    away = torch.maximum((cameras.positions - low).abs(), (cameras.positions - high).abs())
    pixel = float((away.norm(dim=1) / cameras.focal.amin(dim=1)).max())
    return max(BLOCK, min(int(math.sqrt(2) * occupancy.cell / pixel), MOST_BLOCK))


def static_pool(views: Views, model: Renderable, occupancy: Occupancy | None) -> PixelPool:
    """The static training images' pixels: all, or those that hit something in ``occupancy``."""
    device = model.device
    images = torch.arange(len(views), device=device)
    if occupancy is None:
        return all_pixels(views, images)
    hit = rays_hit_occupied(views.cameras.to(device), images, model, occupancy)
    return wanted_pixels(views, images, hit)


@torch.no_grad()
def frame_pools(
    views: Views,
    frame: int,
    model: Renderable,
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
        occupancy: at the frame's time.
        occupied_only: only pixels on the alpha mask, or whose rays hit something occupied; all
            those of an image that has none.
        join_views: one pool of all views; else one pool a view.

    Raises:
        DevrfError: no image shows the frame.
    """
    images = images_of(views, frame)
    if len(images) == 0:
        raise DevrfError(f"dynamic training set: no image at frame {frame}")
    pools = [all_pixels(views, image[None]) for image in images]
    if occupied_only:
        wanted = rays_hit_occupied(views.cameras, images, model, occupancy)
        if views.has_alpha:
            wanted |= views.pixels[images][..., 3].flatten(1) > 0
        for k, whole in enumerate(pools):
            pool = wanted_pixels(views, images[k : k + 1], wanted[k : k + 1])
            pools[k] = pool if len(pool) else whole
    if not join_views:
        return pools
    return [PixelPool(torch.cat([pool.pixels for pool in pools], dim=1))]


def images_of(views: Views, frame: int) -> Tensor:
    """The images (K,) int64 of a frame, ascending."""
    assert views.frames is not None
    return (views.frames == frame).nonzero()[:, 0]


def pixels_for_epochs(epochs: float, pixels: int, iterations: int) -> int:
    """Pixels of a batch, of which ``iterations`` show each of all ``pixels`` ``epochs`` times."""
    return max(round(epochs * pixels / iterations), FEWEST)

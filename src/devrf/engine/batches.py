"""Which pixels an iteration draws, and the batch of rays that they become."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, RayBatch, all_pixels, wanted_pixels
from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.ops.pixel_rays import gather_pixels
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import hits
from devrf.rendering.view import Viewable
from devrf.scenes.scene import Views

# Rays are followed through blocks of so many pixels a side.
BLOCK = 2
# Images whose rays are made together: on a CPU what its caches hold, on a GPU what keeps it busy.
ON_CPU, ON_GPU = 1, 16


def gather_batch(
    views: Views, image: Tensor, flat: Tensor, background: Tensor, space: Space = WORLD
) -> RayBatch:
    """The rays of given pixels in the fields' space, with the truth there.

    Args:
        views: images and cameras, on the device of the indices.
        image: (R,) int64, which image.
        flat: (R,) int64, row-major pixel number within it.
        background: (3,) or (R, 3) RGB in [0, 1] that colours are composited on.
        space: the space that the fields live in.
    """
    assert views.frames is not None, "views of a scene know their frames"
    cameras, flow = views.cameras, views.flow
    gathered = gather_pixels(
        image,
        flat,
        views.pixels,
        cameras.camera_to_world,
        cameras.focal,
        cameras.center,
        background,
        views.times,
        views.frames,
        None if flow is None else (flow.vectors, flow.valid),
    )
    return RayBatch(
        rays=space.rays(Rays(gathered.origins, gathered.directions, gathered.directions)),
        color=gathered.color,
        alpha=gathered.alpha,
        background=background,
        time=gathered.time,
        frame=gathered.frame,
        image=image,
        pixel=gathered.pixel,
        flow=gathered.flow,
        flow_valid=gathered.flow_valid,
    )


@dataclass(frozen=True)
class FramePool:
    """The valid pixels of some images, in the order of their frames.

    Attributes:
        pool: the pixels.
        ends: how many pixels the first k + 1 frames have, for each k.
        images: how many images there are.
    """

    pool: PixelPool
    ends: tuple[int, ...]
    images: int

    @staticmethod
    def of(views: Views, *, centre: bool = False) -> FramePool:
        """All valid pixels of some views; of the ``centre`` half of rows and columns, if any is."""
        assert views.frames is not None
        images = torch.arange(len(views), device=views.frames.device)
        pool = all_pixels(views, images)
        if centre:
            inside = torch.zeros(views.height, views.width, dtype=torch.bool, device=images.device)
            top, left = views.height // 4, views.width // 4
            inside[top : views.height - top, left : views.width - left] = True
            middle = wanted_pixels(views, images, inside.flatten().repeat(len(views), 1))
            pool = middle if len(middle) else pool
        frame = views.frames[pool.image.long()]
        order = frame.argsort(stable=True)
        _, counts = torch.unique(frame, return_counts=True)
        return FramePool(pool[order], tuple(counts.cumsum(0).tolist()), len(views))

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.ends)

    def draw(
        self, count: int, frames: int, generator: torch.Generator, *, moments: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """``count`` pixels with replacement: image and number, (count,) int64 each.

        Args:
            count: how many.
            frames: so many of the first frames are drawn from.
            generator: of the random choice, on the pool's device.
            moments: so many frames alone, as many pixels of each, frame after frame; None: all.
        """
        pool, device = self.pool, self.pool.pixels.device
        if moments is None or moments >= frames:
            last = self.ends[frames - 1]
            pick = torch.randint(last, (count,), device=device, generator=generator)
        else:
            ends = torch.tensor((0, *self.ends), device=device)
            chosen = torch.randperm(frames, device=device, generator=generator)[:moments]
            frame = chosen[torch.arange(count, device=device) * moments // count]
            size = ends[frame + 1] - ends[frame]
            part = torch.rand(count, dtype=torch.float64, device=device, generator=generator)
            pick = ends[frame] + (part * size).long()
        return pool.image[pick].long(), pool.flat[pick].long()


@torch.no_grad()
def rays_hit_occupied(
    cameras: Cameras, images: Tensor, model: Viewable, occupancy: Occupancy
) -> Tensor:
    """Mask (K, H·W): the pixels of images whose rays pass near anything occupied.

    One ray stands for a block of pixels: what is near it reaches far enough for its neighbours too.

    Args:
        cameras: all cameras, on the model's device.
        images: (K,) int64, which of them.
        model: gives box, space, near and far.
        occupancy: where something may be at the time of the images.
    """
    width, height = (-(-size // BLOCK) for size in (cameras.width, cameras.height))
    coarse = cameras.resized(width, height)
    pixels, masks = coarse.pixel_grid(), []
    near, far = model.depth_limits
    together = ON_GPU if images.is_cuda else ON_CPU
    for start in range(0, len(images), together):
        some = images[start : start + together]
        rays = coarse.rays(some.repeat_interleave(len(pixels)), pixels.repeat(len(some), 1))
        hit = hits(model.space.rays(rays), model.box, occupancy, near=near, far=far)
        rows = hit.view(-1, height, width).repeat_interleave(BLOCK, dim=1)[:, : cameras.height]
        masks.append(rows.repeat_interleave(BLOCK, dim=2)[:, :, : cameras.width].flatten(1))
    return torch.cat(masks)


def static_pool(views: Views, model: Viewable, occupancy: Occupancy | None) -> PixelPool:
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
    model: Viewable,
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

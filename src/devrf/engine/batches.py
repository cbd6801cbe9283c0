"""Which pixels an iteration draws, and the batch of rays that they become."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.data.batch import (
    PixelPool,
    RayBatch,
    all_pixels,
    pixel_positions,
    wanted_pixels,
)
from devrf.geometry.space import WORLD, Space
from devrf.scenes.scene import Views


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
    place = image * (views.height * views.width) + flat
    pixel = pixel_positions(flat, views.width)
    shown = views.pixels.flatten(0, 2).index_select(0, place).float() / 255
    color = shown[:, :3]
    alpha = shown[:, 3] if views.has_alpha else None
    if alpha is not None:
        color = background + alpha[:, None] * (color - background)
    flow = flow_valid = None
    if views.flow is not None:
        flow_valid = views.flow.valid.flatten()[place]
        # What was observed where it is not valid may be anything, NaN included.
        flow = torch.where(flow_valid[:, None], views.flow.vectors.flatten(0, 2)[place], 0.0)
    return RayBatch(
        rays=space.rays(views.cameras.rays(image, pixel)),
        color=color,
        alpha=alpha,
        background=background,
        time=views.times[image],
        frame=views.frames[image],
        image=image,
        pixel=pixel,
        flow=flow,
        flow_valid=flow_valid,
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
            top = views.height // 4
            left = views.width // 4
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
        self, count: int, frames: int, generator: torch.Generator, *, times: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """``count`` pixels with replacement: image and number, (count,) int64 each.

        Args:
            count: how many.
            frames: so many of the first frames are drawn from.
            generator: of the random choice, on the pool's device.
            times: so many frames alone, as many pixels of each, frame after frame; None: all.
        """
        pool = self.pool
        device = pool.pixels.device
        if times is None or times >= frames:
            last = self.ends[frames - 1]
            pick = torch.randint(last, (count,), device=device, generator=generator)
        else:
            ends = torch.tensor((0, *self.ends), device=device)
            chosen = torch.randperm(frames, device=device, generator=generator)[:times]
            frame = chosen[torch.arange(count, device=device) * times // count]
            size = ends[frame + 1] - ends[frame]
            part = torch.rand(count, dtype=torch.float64, device=device, generator=generator)
            pick = ends[frame] + (part * size).long()
        return pool.image[pick].long(), pool.flat[pick].long()

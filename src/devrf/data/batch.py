"""Pools of pixels, and batches of rays that are drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.box import constant
from devrf.geometry.cameras import Cameras
from devrf.geometry.rays import Rays
from devrf.scenes.scene import Background, Views, background_value, on_background


@dataclass(frozen=True)
class PixelPool:
    """P pixels of some images.

    Attributes:
        pixels: (2, P) int32, the image of each pixel and its row-major number in the image.
    """

    pixels: Tensor

    def __len__(self) -> int:
        return self.pixels.shape[1]

    @property
    def image(self) -> Tensor:
        """(P,) int32, the image of each pixel."""
        return self.pixels[0]

    @property
    def flat(self) -> Tensor:
        """(P,) int32, its row-major number in the image."""
        return self.pixels[1]

    def __getitem__(self, index: Tensor) -> PixelPool:
        """Some of the pixels."""
        return PixelPool(self.pixels[:, index])

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """``count`` pixels with replacement: image (count,) and number (count,), int64.

        Args:
            count: number of pixels.
            generator: of the random choice, on the pool's device.
        """
        pick = torch.randint(len(self), (count,), device=self.pixels.device, generator=generator)
        image, flat = self.pixels.index_select(1, pick).long().unbind()
        return image, flat

    def mask(self, images: Tensor, area: int) -> Tensor:
        """Mask (K, ``area``) of the pixels of ``images`` (K,), ascending, that the pool has."""
        mask = torch.zeros(len(images), area, dtype=torch.bool, device=self.pixels.device)
        row = torch.searchsorted(images.to(torch.int32), self.image.contiguous())
        mask[row, self.flat.long()] = True
        return mask

    @staticmethod
    def of_mask(images: Tensor, mask: Tensor) -> PixelPool:
        """The pool that :meth:`mask` describes, its pixels in ascending order."""
        row, flat = mask.nonzero().unbind(1)
        return PixelPool(torch.stack([images.to(torch.int32)[row], flat.to(torch.int32)]))


def all_pixels(views: Views, images: Tensor) -> PixelPool:
    """Every valid pixel of ``images`` (K,) int64."""
    area = views.height * views.width
    if views.valid_mask is not None:
        whole = torch.ones(len(images), area, dtype=torch.bool, device=images.device)
        return wanted_pixels(views, images, whole)
    pixels = torch.empty(2, len(images), area, dtype=torch.int32, device=images.device)
    pixels[0] = images[:, None]
    pixels[1] = torch.arange(area, device=images.device)
    return PixelPool(pixels.flatten(1))


def wanted_pixels(views: Views, images: Tensor, wanted: Tensor) -> PixelPool:
    """The valid pixels of ``images`` (K,) int64 that are ``wanted``, (K, H·W) bool."""
    if views.valid_mask is not None:
        valid_mask = views.valid_mask[images.to(views.valid_mask.device)]
        wanted = wanted & valid_mask.flatten(1).to(wanted.device)
    return PixelPool.of_mask(images, wanted)


@dataclass(frozen=True)
class FrameSortedPixels:
    """The valid pixels of some images, sorted by frame.

    Attributes:
        pool: the pixels.
        ends: number of pixels of the first k + 1 frames, for each k.
        images: number of images.
    """

    pool: PixelPool
    ends: tuple[int, ...]
    images: int

    @staticmethod
    def of(views: Views, *, centre: bool = False) -> FrameSortedPixels:
        """All valid pixels of some views; of the ``centre`` half of rows and columns, if any is."""
        assert views.frames is not None
        images = torch.arange(len(views), device=views.frames.device)
        pool = all_pixels(views, images)
        if centre:
            width, height = views.cameras.extents.to(images.device).long()[:, :, None].unbind(1)
            column = torch.arange(views.width, device=images.device)
            row = torch.arange(views.height, device=images.device)
            across = (column >= width // 4) & (column < width - width // 4)
            down = (row >= height // 4) & (row < height - height // 4)
            inside = down[:, :, None] & across[:, None]
            middle = wanted_pixels(views, images, inside.flatten(1))
            pool = middle if len(middle) else pool
        return FrameSortedPixels._sorted(views, pool)

    @staticmethod
    def of_images(views: Views) -> FrameSortedPixels:
        """The first pixel of each image, to draw images."""
        assert views.frames is not None
        images = torch.arange(len(views), dtype=torch.int32, device=views.frames.device)
        pool = PixelPool(torch.stack([images, torch.zeros_like(images)]))
        return FrameSortedPixels._sorted(views, pool)

    @staticmethod
    def _sorted(views: Views, pool: PixelPool) -> FrameSortedPixels:
        assert views.frames is not None
        frame = views.frames[pool.image.long()]
        order = frame.argsort(stable=True)
        _, counts = torch.unique(frame, return_counts=True)
        return FrameSortedPixels(pool[order], tuple(counts.cumsum(0).tolist()), len(views))

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.ends)

    def draw(
        self, count: int, frames: int, generator: torch.Generator, *, times: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """``count`` pixels with replacement: image and number, (count,) int64 each.

        Args:
            count: number of pixels.
            frames: pixels are drawn from so many first frames.
            generator: of the random choice, on the pool's device.
            times: number of frames that are drawn, with equally many pixels of each, frame after
                frame; None: all of them.
        """
        pool = self.pool
        device = pool.pixels.device
        if times is None or times >= frames:
            last = self.ends[frames - 1]
            pick = torch.randint(last, (count,), device=device, generator=generator)
        else:
            ends = torch.tensor((0, *self.ends), device=device)
            drawn_frames = torch.randperm(frames, device=device, generator=generator)[:times]
            frame = drawn_frames[torch.arange(count, device=device) * times // count]
            size = ends[frame + 1] - ends[frame]
            part = torch.rand(count, dtype=torch.float64, device=device, generator=generator)
            pick = ends[frame] + (part * size).long()
        return pool.image[pick].long(), pool.flat[pick].long()


@dataclass(frozen=True)
class RayBatch:
    """R rays with the truth at their pixels.

    Rays of one pixel follow one another, and have the same truth.

    Attributes:
        rays: R rays in the fields' space.
        color: (R, 3) RGB in [0, 1], composited on ``background``.
        alpha: (R,) alpha in [0, 1], or None for images without one.
        background: (3,) or (R, 3) RGB behind the alpha mask.
        time: (R,) the time of each ray in [0, 1].
        frame: (R,) int64, the frame of the scene's clock that is nearest to that time.
        image: (R,) int64, the image of each ray among the views it was drawn from; those of
            several captures are numbered through.
        pixel: (R, 2) x, y of the rays in their images, in pixels.
        flow: (R, 2) pixels, backward optical flow, 0 where it is not valid; or None.
        flow_valid: (R,) bool, or None.
        per_pixel: the rays of each pixel.
    """

    rays: Rays
    color: Tensor
    alpha: Tensor | None
    background: Tensor
    time: Tensor
    frame: Tensor
    image: Tensor
    pixel: Tensor
    flow: Tensor | None
    flow_valid: Tensor | None
    per_pixel: int = 1


@dataclass(frozen=True)
class ImageBatch:
    """An image, or some rows of one, with the truth at its P pixels, in row-major order.

    Attributes:
        camera: one camera, whose raster it is.
        color: (P, 3) RGB in [0, 1], composited on ``background``.
        alpha: (P,) alpha in [0, 1], or None for images without one.
        valid: (P,) bool, the pixels that count; None: all.
        background: (3,) RGB behind the alpha mask.
        time: of the image, in [0, 1].
        image: its number among the views it was drawn from; those of several captures are numbered
            through.
    """

    camera: Cameras
    color: Tensor
    alpha: Tensor | None
    valid: Tensor | None
    background: Tensor
    time: float
    image: int


def gather_image(
    views: Views, image: int, background: Tensor, rows: tuple[int, int], shrink: int = 1
) -> ImageBatch:
    """Some rows of an image, with the truth there.

    Args:
        views: images and cameras.
        image: the number of the image.
        background: (3,) RGB in [0, 1] that colours are composited on.
        rows: the first of the image's rows, and the one after the last.
        shrink: pixels along each edge of the squares whose means become pixels.
    """
    view = views.single(image)
    first, last = rows
    pixels = view.pixels[0, first:last]
    planes = [on_background(pixels, background), pixels[..., 3:].float() / 255]
    if view.valid_mask is not None:
        planes.append(view.valid_mask[0, first:last, :, None].float())
    means = torch.cat(planes, dim=2).permute(2, 0, 1)
    if shrink > 1:
        means = torch.nn.functional.avg_pool2d(means, shrink)
    camera = view.cameras.rows(first, last)
    height, width = means.shape[1:]
    camera = replace(
        camera,
        focal=camera.focal / shrink,
        center=camera.center / shrink,
        width=width,
        height=height,
    )
    flat = means.flatten(1)
    return ImageBatch(
        camera=camera,
        color=flat[:3].t().contiguous(),
        alpha=flat[3] if view.has_alpha else None,
        valid=None if view.valid_mask is None else flat[-1] == 1,
        background=background,
        time=float(view.times[0]),
        image=image,
    )


class BackgroundColor:
    """Colours that images are composited on while a stage learns."""

    def __init__(self, name: Background) -> None:
        """``name``: ``white``, ``black`` or ``random``."""
        self.name = name

    def __call__(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """The colour (3,) behind the pixels of ``image`` (R,), always the same tensor.

        Random colours are (R, 3), drawn with ``generator``.
        """
        device = generator.device
        if self.name == "random":
            return torch.rand(len(image), 3, device=device, generator=generator)
        return constant((background_value(self.name),) * 3, torch.float32, image.device)


def concatenated(batches: Sequence[RayBatch]) -> RayBatch:
    """Batches of images without optical flow as one, one after another.

    Images that have no alpha mask count as opaque beside images that have one.
    """
    alphas = [batch.alpha for batch in batches]
    alpha = None
    if any(a is not None for a in alphas):
        alpha = torch.cat(
            [torch.ones_like(b.time) if b.alpha is None else b.alpha for b in batches]
        )
    return RayBatch(
        rays=Rays.joined([batch.rays for batch in batches]),
        color=torch.cat([batch.color for batch in batches]),
        alpha=alpha,
        background=torch.cat([batch.background.expand(len(batch.rays), 3) for batch in batches]),
        time=torch.cat([batch.time for batch in batches]),
        frame=torch.cat([batch.frame for batch in batches]),
        image=torch.cat([batch.image for batch in batches]),
        pixel=torch.cat([batch.pixel for batch in batches]),
        flow=None,
        flow_valid=None,
    )

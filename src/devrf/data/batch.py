"""Pixels, the pools that they are drawn from, and the batches of rays that they become."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.scenes.scene import Views


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
            count: how many.
            generator: of the random choice, on the pool's device.
        """
        pick = torch.randint(len(self), (count,), device=self.pixels.device, generator=generator)
        image, flat = self.pixels.index_select(1, pick).long().unbind()
        return image, flat

    def mask(self, images: Tensor, area: int) -> Tensor:
        """Which pixels of ``images`` (K,), ascending, are here: (K, ``area``) bool."""
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
        everything = torch.ones(len(images), area, dtype=torch.bool, device=images.device)
        return wanted_pixels(views, images, everything)
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
class Pixels:
    """R pixels to make a batch of.

    Attributes:
        image: (R,) int64, the image of each among the views.
        flat: (R,) int64, its row-major number in the image.
        background: (3,) or (R, 3) RGB in [0, 1] that colours are composited on.
    """

    image: Tensor
    flat: Tensor
    background: Tensor

    def __len__(self) -> int:
        return self.image.shape[0]


@dataclass(frozen=True)
class RayBatch:
    """R rays with the truth at their pixels.

    Attributes:
        rays: R rays in the fields' space.
        color: (R, 3) RGB in [0, 1], composited on ``background``.
        alpha: (R,) alpha in [0, 1], or None for images without one.
        background: (3,) or (R, 3) RGB behind the alpha mask.
        time: (R,) the time of each ray in [0, 1].
        frame: (R,) int64, the frame of the scene's clock that is nearest to that time.
        image: (R,) int64, the image of each ray among the views it was drawn from; those of
            several captures are numbered through.
        pixel: (R, 2) x, y of the pixels' centres.
        flow: (R, 2) pixels, backward optical flow, 0 where it is not valid; or None.
        flow_valid: (R,) bool, or None.
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


def pixel_positions(flat: Tensor, width: int) -> Tensor:
    """Centres (R, 2), x then y, of pixels given by their row-major number (R,)."""
    return torch.stack([flat % width, flat // width], dim=-1) + 0.5


def background_color(name: str, rays: int, generator: torch.Generator) -> Tensor:
    """The background (3,) to learn on, or (R, 3) where it is random.

    Args:
        name: ``white``, ``black`` or ``random``.
        rays: R, the rays of the batch.
        generator: of the random colours; the background is on its device.
    """
    device = generator.device
    if name == "random":
        return torch.rand(rays, 3, device=device, generator=generator)
    return torch.full((3,), 0.0 if name == "black" else 1.0, device=device)


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

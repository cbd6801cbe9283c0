"""The pixels worth learning from, to draw batches from at random."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.scenes.scene import Views


@dataclass(frozen=True)
class PixelPool:
    """P pixels of some images.

    Attributes:
        image: (P,) int32, the image of each pixel.
        flat: (P,) int32, its row-major number in the image.
    """

    image: Tensor
    flat: Tensor

    def __len__(self) -> int:
        return self.image.shape[0]

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """``count`` pixels with replacement: image (count,) and number (count,), int64.

        Args:
            count: how many.
            generator: of the random choice, on the pool's device.
        """
        pick = torch.randint(len(self), (count,), device=self.image.device, generator=generator)
        return self.image[pick].long(), self.flat[pick].long()

    def of_images(self, images: Tensor) -> PixelPool:
        """The pixels that belong to ``images`` (K,)."""
        kept = torch.isin(self.image, images.to(self.image.dtype))
        return PixelPool(self.image[kept], self.flat[kept])

    def mask(self, images: Tensor, area: int) -> Tensor:
        """Which pixels of ``images`` (K,), ascending, are here: (K, ``area``) bool."""
        mask = torch.zeros(len(images), area, dtype=torch.bool, device=self.image.device)
        row = torch.searchsorted(images.to(self.image.dtype), self.image.contiguous())
        mask[row, self.flat.long()] = True
        return mask

    @staticmethod
    def of_mask(images: Tensor, mask: Tensor) -> PixelPool:
        """The pool that :meth:`mask` describes, its pixels in ascending order."""
        row, flat = mask.nonzero().unbind(1)
        return PixelPool(images[row].to(torch.int32), flat.to(torch.int32))


def all_pixels(views: Views, images: Tensor) -> PixelPool:
    """Every valid pixel of ``images`` (K,) int64."""
    area = views.height * views.width
    if views.valid_mask is not None:
        everything = torch.ones(len(images), area, dtype=torch.bool, device=images.device)
        return wanted_pixels(views, images, everything)
    flat = torch.arange(area, dtype=torch.int32, device=images.device)
    return PixelPool(images.to(torch.int32).repeat_interleave(area), flat.repeat(len(images)))


def wanted_pixels(views: Views, images: Tensor, wanted: Tensor) -> PixelPool:
    """The valid pixels of ``images`` (K,) int64 that are ``wanted``, (K, H·W) bool."""
    if views.valid_mask is not None:
        valid_mask = views.valid_mask[images.to(views.valid_mask.device)]
        wanted = wanted & valid_mask.flatten(1).to(wanted.device)
    return PixelPool.of_mask(images, wanted)

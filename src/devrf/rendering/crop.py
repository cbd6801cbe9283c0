"""Rays that see only what lies in a box."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.geometry.space import Space
from devrf.rendering.rendered_image import RenderedImage


@dataclass(frozen=True)
class CroppedRays:
    """Rays that begin where they enter a box.

    What is before the box is cut off exactly. What is behind it is left out pixel by pixel: where
    the mean depth lies behind the box, the background is seen.

    Attributes:
        rays: the K of R rays that meet the box, in the fields' space, from where they enter it.
        hit: (R,) bool, which they are.
        skipped: (K,) the distance from the origin of each ray to where it begins now.
        length: (K,) the distance from there to where it leaves the box.
    """

    rays: Rays
    hit: Tensor
    skipped: Tensor
    length: Tensor

    @staticmethod
    def of(rays: Rays, box: Box, space: Space, near: float) -> CroppedRays:
        """Crop world rays.

        Args:
            rays: R rays in world space.
            box: in the fields' space; of a contracted scene in its inner box, where that is the
                world.
            space: the fields' space.
            near: the distance before which a view samples nothing.
        """
        lines = space.rays(rays) if space.straight else rays
        entry, leave = lines.crossing(*box.corners(lines.origins), 0.0, math.inf)
        hit = entry < leave
        lines, entry, leave = lines[hit], entry[hit], leave[hit]
        skipped = (entry - near).clamp(min=0)
        lines = replace(lines, origins=lines.origins + skipped[:, None] * lines.directions)
        if not space.straight:
            lines = space.rays(lines)
        return CroppedRays(lines, hit, skipped, leave - skipped)

    def completed(self, image: RenderedImage, background: Tensor) -> RenderedImage:
        """The image of all R rays from that of the K, with the background (3,) elsewhere."""
        inside = image.depth <= self.length
        seen = self.hit.clone()
        seen[self.hit] = inside
        color = background.expand(len(self.hit), 3).clone()
        color[seen] = image.color[inside]
        depth, opacity = (torch.zeros_like(self.hit, dtype=color.dtype) for _ in range(2))
        depth[seen] = (image.depth + self.skipped)[inside]
        opacity[seen] = image.opacity[inside]
        return RenderedImage(color, depth, opacity)

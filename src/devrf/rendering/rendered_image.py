"""A rendered image: colours, depths and opacities, without gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.rendering.output import RenderOutput


@dataclass(frozen=True)
class RenderedImage:
    """The rendering of R rays: an image, or a part of one.

    Attributes:
        color: (R, 3) RGB in [0, 1].
        depth: (R,) mean distance of the visible samples along the ray; 0 where there are none.
        opacity: (R,) in [0, 1], 1 − T_end.
    """

    color: Tensor
    depth: Tensor
    opacity: Tensor

    @staticmethod
    def of(output: RenderOutput) -> RenderedImage:
        """The image in a renderer's output."""
        return RenderedImage(output.color, output.depth, 1 - output.transmittance)

    @staticmethod
    def joined(parts: Sequence[RenderedImage]) -> RenderedImage:
        """The rays of several parts, one part after another."""
        return RenderedImage(
            torch.cat([part.color for part in parts]),
            torch.cat([part.depth for part in parts]),
            torch.cat([part.opacity for part in parts]),
        )

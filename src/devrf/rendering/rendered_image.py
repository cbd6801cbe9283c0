"""What rays see, to be looked at: without gradients, and without what the losses ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.rendering.output import RenderOutput


@dataclass(frozen=True)
class RenderedImage:
    """What R rays see, to be looked at.

    Attributes:
        color: (R, 3) RGB in [0, 1].
        depth: (R,) mean distance of what is seen along the ray; 0 where nothing is.
        opacity: (R,) in [0, 1], 1 − T_end.
    """

    color: Tensor
    depth: Tensor
    opacity: Tensor

    @staticmethod
    def of(output: RenderOutput) -> RenderedImage:
        """What there is to look at in a renderer's output."""
        return RenderedImage(output.color, output.depth, 1 - output.transmittance)

    @staticmethod
    def joined(parts: Sequence[RenderedImage]) -> RenderedImage:
        """What all rays of some images see, one image after another."""
        return RenderedImage(
            torch.cat([part.color for part in parts]),
            torch.cat([part.depth for part in parts]),
            torch.cat([part.opacity for part in parts]),
        )

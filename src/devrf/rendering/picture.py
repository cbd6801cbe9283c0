"""What rays see, to be looked at: without gradients, and without what the losses ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.rendering.render import RenderOutput


@dataclass(frozen=True)
class Picture:
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
    def of(output: RenderOutput) -> Picture:
        """What there is to look at in a renderer's output."""
        return Picture(output.color, output.depth, 1 - output.transmittance)

    @staticmethod
    def joined(parts: Sequence[Picture]) -> Picture:
        """What all rays of some pictures see, one picture after another."""
        return Picture(
            torch.cat([part.color for part in parts]),
            torch.cat([part.depth for part in parts]),
            torch.cat([part.opacity for part in parts]),
        )

"""Outputs of renderers: a method's, with gradients, and images, without."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from devrf.ops.march import Samples

# Canonical points (M, 3) → A_t there (M, 3), added to the logits of their colours.
ColorResidual = Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class RenderOutput:
    """The rendering of R rays.

    Attributes:
        color: (R, 3) RGB, composited on the background: C = Σ w_i c_i + T_end · background.
        depth: (R,) mean distance of the samples, weighted by w_i; 0 where all weights are.
        transmittance: (R,) T_end, behind the last sample.
        extras: further tensors by name, for the losses of the method that rendered.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor
    extras: Mapping[str, Tensor] = field(default_factory=dict)


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
    def mean(images: Sequence[RenderedImage]) -> RenderedImage:
        """The picture whose pixels are the means of those of ``images``.

        A pixel's depth is that of its most opaque ray: between two surfaces there is nothing.
        """
        if len(images) == 1:
            return images[0]
        color, depth, opacity = (
            torch.stack([getattr(image, name) for image in images])
            for name in ("color", "depth", "opacity")
        )
        seen = depth.gather(0, opacity.argmax(dim=0, keepdim=True))[0]
        return RenderedImage(color.mean(dim=0), seen, opacity.mean(dim=0))

    @staticmethod
    def joined(parts: Sequence[RenderedImage]) -> RenderedImage:
        """The rays of one part or more, one part after another."""
        if len(parts) == 1:
            return parts[0]
        return RenderedImage(
            color=torch.cat([part.color for part in parts]),
            depth=torch.cat([part.depth for part in parts]),
            opacity=torch.cat([part.opacity for part in parts]),
        )


@dataclass(frozen=True, kw_only=True)
class VoxelOutput(RenderOutput):
    """The rendering of R rays, and the K samples whose colour was computed.

    Attributes:
        samples: their positions x_i at the rays' time and q_i in canonical space, and weights w_i.
        sample_color: (K, 3) their colours c_i.
        background: (3,) or (R, 3), behind all.
        color_residual: (K, 3) A_t(q_i) in logits; None without one.
    """

    samples: Samples
    sample_color: Tensor
    background: Tensor
    color_residual: Tensor | None = None

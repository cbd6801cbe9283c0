"""Numbers as colours, for pictures that people look at."""

from __future__ import annotations

import torch
from kornia.color import ColorMap, apply_colormap
from torch import Tensor


def depth_colors(depth: Tensor, opacity: Tensor, near: float, far: float) -> Tensor:
    """A depth picture: near bright, far dark, nothing white.

    Args:
        depth: (H, W) distances in world units.
        opacity: (H, W) in [0, 1].
        near: the distance shown brightest.
        far: the distance shown darkest.

    Returns:
        (H, W, 3) RGB in [0, 1].
    """
    closeness = 1 - ((depth - near) / (far - near)).clamp(0, 1)
    colors = _mapped(closeness, "viridis")
    return 1 + opacity[..., None] * (colors - 1)


def error_colors(prediction: Tensor, truth: Tensor, full: float = 0.25) -> Tensor:
    """An error picture (H, W, 3): the mean absolute difference of (H, W, 3) images.

    Black is none; the brightest colour stands for ``full`` or more.
    """
    return _mapped(((prediction - truth).abs().mean(dim=-1) / full).clamp(0, 1), "hot")


def to_bytes(image: Tensor) -> Tensor:
    """An image in [0, 1] as uint8, rounded."""
    return (image.clamp(0, 1) * 255).round().to(torch.uint8)


def _mapped(values: Tensor, name: str) -> Tensor:
    table = ColorMap(base=name, num_colors=256)
    return apply_colormap(values[None, None].cpu().float(), table)[0].permute(1, 2, 0)

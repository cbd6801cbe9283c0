"""Numbers as colours, for pictures that people look at."""

from __future__ import annotations

import math

import torch
from kornia.color import ColorMap, apply_colormap, hsv_to_rgb
from torch import Tensor

# The grey of what is not known: no flow has it, for theirs are white or saturated.
UNKNOWN = 0.85


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


def flow_colors(vectors: Tensor, valid: Tensor, full: float) -> Tensor:
    """Optical flow as colours: hue is direction, saturation length, white is no motion.

    Args:
        vectors: (H, W, 2) pixels, x to the right, then y down.
        valid: (H, W) bool; elsewhere the picture is grey.
        full: the length in pixels from which on colours are saturated.

    Returns:
        (H, W, 3) RGB in [0, 1].
    """
    x, y = torch.where(valid[..., None], vectors, 0.0).float().unbind(-1)
    hue = torch.atan2(-y, x) % (2 * math.pi)  # counted upwards, as angles are drawn
    saturation = (torch.hypot(x, y) / max(full, 1e-6)).clamp(0, 1)
    hsv = torch.stack([hue, saturation, 1 - 0.1 * saturation])
    colors: Tensor = hsv_to_rgb(hsv[None])[0].permute(1, 2, 0)
    return torch.where(valid[..., None], colors, UNKNOWN)


def flow_wheel(side: int) -> Tensor:
    """What the colours of :func:`flow_colors` mean: (side, side, 3), white outside the disc."""
    at = (torch.arange(side) + 0.5) / side * 2 - 1
    y, x = torch.meshgrid(at, at, indexing="ij")
    vectors = torch.stack([x, y], dim=-1)
    inside = torch.hypot(x, y) <= 1
    return torch.where(inside[..., None], flow_colors(vectors, inside, 1.0), 1.0)


def to_bytes(image: Tensor) -> Tensor:
    """An image in [0, 1] as uint8, rounded."""
    return (image.clamp(0, 1) * 255).round().to(torch.uint8)


def _mapped(values: Tensor, name: str) -> Tensor:
    table = ColorMap(base=name, num_colors=256)
    return apply_colormap(values[None, None].cpu().float(), table)[0].permute(1, 2, 0)

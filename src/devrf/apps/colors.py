"""Depth, errors and optical flow as colours."""

from __future__ import annotations

import math

import torch
from kornia.color import ColorMap, apply_colormap, hsv_to_rgb
from torch import Tensor

# Grey level of invalid flow; valid flow is white or coloured.
UNKNOWN = 0.85


def depth_colors(depth: Tensor, opacity: Tensor, near: float, far: float) -> Tensor:
    """Depth as RGB (H, W, 3) in [0, 1]: ``near`` bright, ``far`` dark, empty space white.

    Args:
        depth: (H, W) distances, in the unit of ``near`` and ``far``.
        opacity: (H, W) in [0, 1].
        near: the distance shown brightest.
        far: the distance shown darkest.
    """
    closeness = 1 - ((depth - near) / (far - near)).clamp(0, 1)
    colors = _mapped(closeness, "viridis")
    return 1 + opacity[..., None] * (colors - 1)


def error_colors(prediction: Tensor, truth: Tensor) -> Tensor:
    """The mean absolute difference of (H, W, 3) images as RGB: 0 is black, 0.25 or more white."""
    return _mapped((4 * (prediction - truth).abs().mean(dim=-1)).clamp(0, 1), "hot")


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
    """The key to :func:`flow_colors` (side, side, 3): a disc of all directions, white outside."""
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

"""Signed-distance primitives: negative inside, positive outside, never steeper than 1.

All take coordinates in the primitive's own frame (world units, any broadcastable shapes) and
return the exact distance outside; a sphere tracer may step by it without crossing a surface.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Lengths that a caller may give as a number, or as a tensor of one length for each primitive.
Length = float | Tensor


def sphere(x: Tensor, y: Tensor, z: Tensor, radius: Length) -> Tensor:
    """A ball of ``radius`` about the origin."""
    return (x * x + y * y + z * z).sqrt() - radius


def rounded_box(
    x: Tensor, y: Tensor, z: Tensor, half: tuple[Length, Length, Length], rounding: Length
) -> Tensor:
    """A box with outer half edges ``half``, edges rounded by ``rounding`` ≤ min(half).

    A rounding equal to the two smaller half edges makes a capsule, to all three a ball.
    """
    qx, qy, qz = (c.abs() - (h - rounding) for c, h in zip((x, y, z), half, strict=True))
    px, py, pz = qx.clamp_min(0), qy.clamp_min(0), qz.clamp_min(0)
    outside = (px * px + py * py + pz * pz).sqrt()
    inside = torch.maximum(torch.maximum(qx, qy), qz).clamp_max(0)
    return outside + inside - rounding


def rounded_cylinder(
    x: Tensor, y: Tensor, z: Tensor, radius: float, half_height: float, rounding: float
) -> Tensor:
    """An upright cylinder about z with outer ``radius`` and ``half_height``, rims rounded."""
    across, up = torch.hypot(x, y) - (radius - rounding), z.abs() - (half_height - rounding)
    outside = torch.hypot(across.clamp_min(0), up.clamp_min(0))
    return outside + torch.maximum(across, up).clamp_max(0) - rounding


def blade(
    x: Tensor, y: Tensor, z: Tensor, half_length: float, half_width: float, thickness: float
) -> Tensor:
    """A leaf: a pointed lens in the x-y plane, inflated by ``thickness``.

    The lens is where two equal discs overlap; its tips are at x = ± half_length, its sides at
    y = ± half_width.
    """
    # A disc with its centre on the y axis that passes the tip (a, 0) and the side (0, b).
    offset = (half_length**2 - half_width**2) / (2 * half_width)
    radius = offset + half_width
    ax, ay = x.abs(), y.abs()
    facing_arc = (ay + offset) * half_length >= offset * ax
    lens = torch.where(
        facing_arc,
        torch.hypot(ax, ay + offset) - radius,
        torch.hypot(ax - half_length, ay),
    )
    return torch.hypot(lens.clamp_min(0), z) - thickness

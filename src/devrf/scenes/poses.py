"""Camera poses from files: which of them can be the pose of a camera."""

from __future__ import annotations

import torch
from torch import Tensor

# Rotations are written with 5 digits or more; further off they are scaled, sheared or mirrored.
ROTATION_TOLERANCE = 1e-2
# World units in which a distance, squared twice, still is a float32.
FARTHEST = 1e9


def is_rotation(matrices: Tensor) -> Tensor:
    """Which matrices (..., 3, 3) turn without scaling, shearing or mirroring, up to rounding.

    Returns:
        A mask (...,); false where a matrix holds NaN.
    """
    eye = torch.eye(3).to(matrices)
    off = (matrices.mT @ matrices - eye).abs().amax(dim=(-2, -1))
    upright: Tensor = (off <= ROTATION_TOLERANCE) & (torch.linalg.det(matrices) > 0)
    return upright


def in_reach(positions: Tensor) -> Tensor:
    """Which positions (..., 3), world units, can be computed with; false where one holds NaN."""
    near: Tensor = (positions.abs() <= FARTHEST).all(dim=-1)
    return near

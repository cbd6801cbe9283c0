"""The average of camera poses, and poses seen from another one: how a capture is centred."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize


def average_pose(poses: Tensor) -> Tensor:
    """A rigid pose in the middle of others (NeRF's recentring).

    Its position is the mean position, its z axis the direction of the mean z axis, and its y
    axis as near to the mean y axis as it can be.

    Args:
        poses: (N, 3, 4) rigid camera-to-world transforms.

    Returns:
        (3, 4), the dtype of ``poses``; NaN or degenerate where z or y axes cancel out.
    """
    back = normalize(poses[:, :, 2].sum(dim=0), dim=0)
    right = normalize(torch.linalg.cross(poses[:, :, 1].sum(dim=0), back), dim=0)
    up = torch.linalg.cross(back, right)
    return torch.stack([right, up, back, poses[:, :, 3].mean(dim=0)], dim=1)


def relative_to(frame: Tensor, poses: Tensor) -> Tensor:
    """Poses (N, 3, 4) in a world in which the rigid pose ``frame`` (3, 4) is the identity."""
    turned = frame[:, :3].T @ poses
    turned[:, :, 3] -= frame[:, :3].T @ frame[:, 3]
    return turned

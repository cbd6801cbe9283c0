"""Rigid poses: their average, poses relative to one of them, and motion along a screw."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

# Up to this squared angle A, B and C are summed: in single precision their quotients lose digits,
# and their second derivatives lose all of them at θ = 0.01.
SMALL = 0.25
TERMS = 6


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


def relative_to(frame: Tensor, poses: Tensor, scale: float = 1.0) -> Tensor:
    """Poses (N, 3, 4) in a world in which the rigid pose ``frame`` (3, 4) is the identity.

    That world is ``scale`` times larger.
    """
    turned = frame[:, :3].T @ poses
    turned[:, :, 3] -= frame[:, :3].T @ frame[:, 3]
    turned[:, :, 3] *= scale
    return turned


def from_opencv(world_to_camera: Tensor) -> Tensor:
    """Camera-to-world poses, OpenGL axes, of OpenCV's rigid world-to-camera transforms.

    Args:
        world_to_camera: (..., 3, 4) or (..., 4, 4), whose last row is not read.

    Returns:
        (..., 3, 4).
    """
    turned = world_to_camera[..., :3, :3].mT
    # OpenCV's y points down and its z ahead; ours point up and back.
    axes = turned * turned.new_tensor([1, -1, -1])
    return torch.cat([axes, -(turned @ world_to_camera[..., :3, 3:])], dim=-1)


def to_opencv(camera_to_world: Tensor) -> Tensor:
    """The inverse of :func:`from_opencv`: world-to-camera (..., 3, 4)."""
    turned = (camera_to_world[..., :3] * camera_to_world.new_tensor([1, -1, -1])).mT
    return torch.cat([turned, -(turned @ camera_to_world[..., 3:])], dim=-1)


def rigid_motion(points: Tensor, rotation: Tensor, velocity: Tensor) -> Tensor:
    """x′ = e^{[r]} x + G v: the exponential of se(3), a motion along a screw.

    With θ = |r|, [r] y = r × y, A = sin θ / θ, B = (1 − cos θ) / θ², C = (θ − sin θ) / θ³:
    e^{[r]} = I + A [r] + B [r]² and G = I + B [r] + C [r]². They are sums of series up to θ = 0.5.

    Args:
        points: (..., 3) x.
        rotation: (..., 3) r, radians along the axis.
        velocity: (..., 3) v, in the unit of the points.

    Returns:
        (..., 3) x′.
    """
    square: Tensor = (rotation * rotation).sum(dim=-1, keepdim=True)
    near = square < SMALL
    # The branch that is not taken must have finite gradients, too.
    safe = torch.where(near, torch.ones_like(square), square)
    angle = safe.sqrt()
    sine = angle.sin()
    cosine = angle.cos()
    a: Tensor = torch.where(near, _series(square, 1), sine / angle)
    b: Tensor = torch.where(near, _series(square, 2), (1 - cosine) / safe)
    c: Tensor = torch.where(near, _series(square, 3), (angle - sine) / (safe * angle))
    turned: Tensor = torch.linalg.cross(rotation, points)
    driven: Tensor = torch.linalg.cross(rotation, velocity)
    twice: Tensor = torch.linalg.cross(rotation, b * turned + c * driven)
    return points + a * turned + velocity + b * driven + twice


def _series(square: Tensor, first: int) -> Tensor:
    """Σ_k (−θ²)^k / (2k + ``first``)!: A, B and C for 1, 2 and 3."""
    total = torch.zeros_like(square)
    for k in reversed(range(TERMS)):
        total = 1 / math.factorial(2 * k + first) - square * total
    return total

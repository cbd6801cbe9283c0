"""Camera rigs that face a scene from one side, centred as LLFF's readers centre them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from devrf.geometry.cameras import Cameras
from devrf.geometry.poses import average_pose, relative_to

FIELD_OF_VIEW = 1.05  # radians across the image's longer side
# Half axes (x, y) of the ellipse of static cameras and of that of the fixed dynamic ones; all
# look at one point on the −z axis. World units.
_STATIC = (0.45, 0.24)
_DYNAMIC = (0.36, 0.18)
_HELD_OUT = (0.07, -0.04)
_TARGET_DEPTH = 3.4
# Static cameras deviate this much from a plane, as hand-held ones do.
_UNEVEN = 0.05


def static_rig(count: int, *, width: int, height: int) -> Cameras:
    """``count`` cameras evenly over an ellipse, whose average pose is the identity.

    Args:
        count: number of cameras.
        width: image width in pixels.
        height: image height in pixels.
    """
    index = torch.arange(count, dtype=torch.float64)
    radius = ((index + 0.5) / count).sqrt()
    angle = math.pi * (3 - math.sqrt(5)) * index
    x, y = _STATIC[0] * radius * angle.cos(), _STATIC[1] * radius * angle.sin()
    positions = torch.stack([x, y, _UNEVEN * (2.0 * index).sin()], dim=-1)
    return _facing(positions, width, height, centred=True)


def dynamic_rig(train: int, *, width: int, height: int) -> tuple[Cameras, Cameras]:
    """``train`` fixed cameras on an ellipse, and one held out near its middle.

    Args:
        train: number of cameras to learn from.
        width: image width in pixels.
        height: image height in pixels.
    """
    angle = math.pi / 4 + 2 * math.pi * torch.arange(train, dtype=torch.float64) / train
    level = torch.zeros_like(angle)
    around = torch.stack([_DYNAMIC[0] * angle.cos(), _DYNAMIC[1] * angle.sin(), level], dim=-1)
    middle = torch.tensor([[*_HELD_OUT, 0.0]], dtype=torch.float64)
    return _facing(around, width, height), _facing(middle, width, height)


def _facing(positions: Tensor, width: int, height: int, *, centred: bool = False) -> Cameras:
    """Float32 cameras at positions (N, 3) float64 that look at the rig's target, y up."""
    cameras = Cameras.looking_at(
        positions,
        positions.new_tensor([0.0, 0.0, -_TARGET_DEPTH]).expand_as(positions),
        focal=max(width, height) / 2 / math.tan(FIELD_OF_VIEW / 2),
        width=width,
        height=height,
        up=positions.new_tensor([0.0, 1.0, 0.0]),
    )
    poses = cameras.camera_to_world
    if centred:
        poses = relative_to(average_pose(poses), poses)
    return replace(
        cameras,
        camera_to_world=poses.float(),
        focal=cameras.focal.float(),
        center=cameras.center.float(),
    )

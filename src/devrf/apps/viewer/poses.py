"""Cameras as the browser has them: a quaternion, OpenCV's axes, a vertical angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from kornia.geometry.conversions import (
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from devrf.geometry.cameras import Cameras

if TYPE_CHECKING:
    from viser import CameraHandle

# From OpenGL's camera axes (y up, z backwards) to OpenCV's (y down, z forwards), and back.
FLIP = (1.0, -1.0, -1.0)


@dataclass(frozen=True)
class Pose:
    """A camera of the browser.

    Attributes:
        wxyz: the unit quaternion of camera to world, OpenCV axes (x right, y down, z forwards).
        position: (x, y, z) in world units.
        fov: the vertical angle of view in radians.
        aspect: width over height.
    """

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    aspect: float

    @staticmethod
    def of(camera_to_world: Tensor, fov: float, aspect: float) -> Pose:
        """The pose of a camera (3, 4) with OpenGL axes; ``fov`` in radians."""
        pose = camera_to_world.double().cpu()
        turned = pose[:, :3] * pose.new_tensor(FLIP)
        wxyz = rotation_matrix_to_quaternion(turned[None])[0]
        return Pose(tuple(wxyz.tolist()), tuple(pose[:, 3].tolist()), fov, aspect)

    @staticmethod
    def of_browser(camera: CameraHandle) -> Pose:
        """The pose that a page is looked at from."""
        return Pose(tuple(camera.wxyz), tuple(camera.position), camera.fov, camera.aspect)

    @staticmethod
    def of_cameras(cameras: Cameras, index: int) -> Pose:
        """The pose of one of N cameras."""
        fov = 2 * math.atan(cameras.height / 2 / float(cameras.focal[index, 1]))
        # Its pixels need not be square.
        wide = 2 * math.atan(cameras.width / 2 / float(cameras.focal[index, 0]))
        return Pose.of(cameras.camera_to_world[index], fov, math.tan(wide / 2) / math.tan(fov / 2))

    @property
    def camera_to_world(self) -> Tensor:
        """(3, 4) float64, OpenGL axes."""
        turned = quaternion_to_rotation_matrix(_row(self.wxyz))[0]
        rotation = turned * turned.new_tensor(FLIP)
        return torch.cat([rotation, _row(self.position).T], dim=1)

    def camera(self, height: int) -> Cameras:
        """One camera, with images ``height`` pixels high."""
        width = max(1, round(self.aspect * height))
        focal = height / 2 / math.tan(self.fov / 2)
        return Cameras(
            self.camera_to_world.float()[None],
            torch.tensor([[focal, focal]]),
            torch.tensor([[width / 2, height / 2]]),
            width,
            height,
        )


def _row(numbers: Sequence[float]) -> Tensor:
    return torch.tensor([[float(one) for one in numbers]], dtype=torch.float64)

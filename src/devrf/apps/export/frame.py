"""The frame of reference of formats that have one of their own: y up, metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.apps.export.settings import Up
from devrf.geometry.cameras import Cameras

AXES = "xyz"


@dataclass(frozen=True)
class UpFrame:
    """The way from the capture's world to right-handed axes with y up, in metres.

    Attributes:
        rotation: (3, 3) axes of the world onto axes of the frame.
        metres: length of a unit of the world.
        up: the world's axis that becomes y.
    """

    rotation: Tensor
    metres: float
    up: str

    @classmethod
    def of(cls, cameras: Cameras, up: Up, metres: float) -> UpFrame:
        """The frame of a scene.

        Args:
            cameras: that saw it, for ``up=auto``: the axis nearest to their mean up.
            up: the world's axis that points up.
            metres: length of a unit of the world.
        """
        if up == "auto":
            mean = cameras.camera_to_world[:, :, 1].mean(dim=0)
            axis = int(mean.abs().argmax())
            sign = -1.0 if mean[axis] < 0 else 1.0
        else:
            axis, sign = AXES.index(up[-1]), -1.0 if up.startswith("-") else 1.0
        y = torch.zeros(3)
        y[axis] = sign
        x = torch.zeros(3)
        x[1 if axis == 0 else 0] = 1.0
        name = ("-" if sign < 0 else "") + AXES[axis]
        return cls(torch.stack([x, y, torch.linalg.cross(x, y)]), metres, name)

    def points(self, points: Tensor) -> Tensor:
        """Points (..., 3) of the world in the frame."""
        return self.metres * (points @ self.rotation.T)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Cameras of the world in the frame."""
        pose = cameras.camera_to_world
        turned = self.rotation @ pose[:, :, :3]
        return replace(
            cameras,
            camera_to_world=torch.cat([turned, self.points(pose[:, :, 3])[:, :, None]], dim=2),
        )

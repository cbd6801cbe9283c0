"""A scene at rest as a field of which a surface can be taken: what exports need of a method."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from devrf.geometry.box import Box


class SurfaceField(Protocol):
    """What is where at rest, as a function of canonical points in the fields' space."""

    @property
    def box(self) -> Box:
        """What holds the scene at rest, in the fields' space."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points along x, y, z of a grid over the box that is as fine as the field."""
        ...

    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of a way of one voxel at ``points`` (M, 3), so that its opacity is 1 − exp(−τ).

        0 where nothing is rendered.
        """
        ...

    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) in [0, 1], as in the images, at ``points`` (M, 3).

        Args:
            points: in the fields' space.
            viewdirs: (M, 3) unit viewing directions in world space, from the eye to the points.
        """
        ...

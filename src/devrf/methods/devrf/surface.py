"""DeVRF's canonical field, of which a surface can be taken."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.rendering.occupancy import Occupancy


class CanonicalSurface:
    """The radiance field at rest, as :class:`~devrf.rendering.view.SurfaceField`.

    Opacities are those of a voxel of the full grid (docs/method.md#step-length).
    """

    def __init__(self, field: CanonicalField, occupancy: Occupancy) -> None:
        """Look at a field.

        Args:
            field: the canonical field.
            occupancy: where something is at rest; elsewhere nothing is rendered.
        """
        self._field, self._occupancy = field, occupancy

    @property
    def box(self) -> Box:
        """Where the field lives."""
        return self._field.box

    @property
    def shape(self) -> tuple[int, int, int]:
        """The density grid's points along x, y, z."""
        return self._field.density.shape

    @torch.no_grad()
    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of one voxel, 0 in cells that are known to be empty."""
        depth = self._field.optical_depth(points, self._field.step_in_base_voxels(1.0))
        return torch.where(self._occupancy.at(points), depth, 0.0)

    @torch.no_grad()
    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) of points, each seen in its own direction."""
        return self._field.rgb(points, viewdirs, torch.arange(len(points), device=points.device))

"""A DeVRF scene's surface at rest."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.rendering.occupancy import Occupancy


@dataclass(frozen=True)
class CanonicalSurface:
    """The radiance field at rest, as :class:`~devrf.rendering.view.SurfaceField`.

    Opacities are those of a voxel of the full grid (docs/method.md#step-length).
    """

    field: CanonicalField
    occupancy: Occupancy

    @property
    def box(self) -> Box:
        """The field's box."""
        return self.field.box

    @property
    def shape(self) -> tuple[int, int, int]:
        """The density grid's points along x, y, z."""
        return self.field.density.shape

    @torch.no_grad()
    def optical_depth(self, points: Tensor) -> Tensor:
        """τ (M,) of one voxel, 0 in cells that are known to be empty."""
        depth = self.field.optical_depth(points, self.field.step_in_base_voxels(1.0))
        return torch.where(self.occupancy.at(points), depth, 0.0)

    @torch.no_grad()
    def color(self, points: Tensor, viewdirs: Tensor) -> Tensor:
        """RGB (M, 3) of points, each seen in its own direction."""
        return self.field.rgb(points, viewdirs, torch.arange(len(points), device=points.device))

"""What both stages of DeVRF share: how a batch is rendered to learn from it."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.engine.graphs import Graphs
from devrf.engine.stage import ScheduledStage
from devrf.geometry.rays import Rays
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import Precision
from devrf.methods.devrf.static_shape.training import render_static
from devrf.methods.devrf.volume_rendering import VoxelOutput, render
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.system.machine import multiplies_bfloat16


class VoxelStage(ScheduledStage):
    """A stage that learns voxel grids.

    Attributes:
        scene_model: the canonical field, its occupancy, and how it deforms.
        decoder_precision: what the colour network computes in while it learns.
    """

    scene_model: DeVRFModel

    def __init__(
        self,
        iterations_per_step: int,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
    ) -> None:
        super().__init__(iterations_per_step, graphs)
        self.decoder_precision = decoder_precision

    def current_model(self) -> DeVRFModel:
        """The model with all that has been learned so far in its place."""
        return self.scene_model

    def render_rays(
        self,
        rays: Rays,
        occupancy: Occupancy,
        background: Tensor,
        capacity: SampleCapacity | None,
        warp: GridWarp | None = None,
    ) -> VoxelOutput:
        """Render rays to learn from them, in lists of fixed length if there is a ``capacity``."""
        model, precision = self.scene_model, self._precision
        fields = model.canonical, occupancy, model.settings, background, warp
        if capacity is None:
            return render(rays, *fields, precision)
        return render_static(rays, *fields, capacity, precision)

    @property
    def _precision(self) -> torch.dtype:
        """What the colour network computes in on the stage's device."""
        chosen = self.decoder_precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        return torch.bfloat16 if reduced else torch.float32

"""What the stages share: how a batch is drawn and rendered, and how its loss terms are weighed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor

from devrf.accel.graphs import Graphs
from devrf.data.batch import PixelPool, Pixels, RayBatch
from devrf.engine.batches import gather_batch
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.fused_losses import Weighted, fused_losses
from devrf.methods.devrf.losses import Prediction
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import Precision
from devrf.methods.devrf.volume_rendering import render
from devrf.methods.weighted_loss import visibility, weighted_sum
from devrf.ops.dispatch import triton_runs
from devrf.rendering.list_rendering import render_static
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, VoxelOutput
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.scenes.scene import Views
from devrf.system.device import multiplies_bfloat16
from devrf.system.profiling import span

Predicted = TypeVar("Predicted", bound=Prediction)


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
        """The model, everything that has been learned so far written back."""
        return self.scene_model

    def draw_pixels(self, pool: PixelPool) -> Pixels:
        """A batch of random pixels of a pool."""
        with span("batch"):
            image, flat = pool.draw(self.loop.rays, self.generator)
            return Pixels(image, flat, self.background(image))

    def render_pixels(
        self,
        views: Views,
        pixels: Pixels,
        occupancy: Occupancy,
        capacity: SampleCapacity | None,
        warp: GridWarp | None = None,
        color_change: ColorChange | None = None,
    ) -> tuple[VoxelOutput, RayBatch]:
        """Render pixels of ``views``, in lists of fixed length if there is a ``capacity``."""
        model, precision = self.scene_model, self._precision
        with span("batch"):
            batch = gather_batch(views, pixels.image, pixels.flat, pixels.background, model.space)
        fields = model.canonical, occupancy, model.settings, batch.background
        if capacity is None:
            return render(batch.rays, *fields, warp, precision, color_change), batch
        moved = ((), 0.0) if warp is None else (warp.slices, warp.weight)
        listed = render_static(batch.rays, *fields, *moved, capacity, precision, color_change)
        return listed, batch

    def static_shape(self, density: Tensor) -> bool:
        """Whether batches are rendered in lists of fixed length: where Triton runs.

        Its kernels take straight rays, which contracted space does not have.
        """
        return self.scene_model.space.is_linear and triton_runs(density)

    @property
    def _precision(self) -> torch.dtype:
        """What the colour network computes in on the stage's device."""
        chosen = self.decoder_precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        return torch.bfloat16 if reduced else torch.float32


def weighted_loss(
    prediction: Predicted,
    terms: Mapping[str, Callable[[Predicted], Tensor]],
    weights: Mapping[str, float],
) -> Weighted:
    """Σ weight · term (); each term's value and how much rays hit, detached, by name.

    Args:
        prediction: what a batch's rays see, and the truth.
        terms: what can be computed, by name.
        weights: of the terms that count.
    """
    parts: list[Weighted] = []
    output = prediction.output
    if output.first is not None and triton_runs(output.color, output.sample_color):
        parts = fused_losses(prediction, output.first, weights)
    known = {name for _, values in parts for name in values}
    others = {name: terms[name](prediction) for name in weights if name not in known}
    if others:
        parts.append(weighted_sum(others, weights))
    total, values = parts[0]
    for part, further in parts[1:]:
        total, values = total + part, values | further
    if "opacity" not in values:
        values |= visibility(prediction.output.transmittance, prediction.batch.alpha)
    return total, values

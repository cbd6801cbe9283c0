"""What the stages share: how a batch is drawn and rendered, and the rates of a field."""

from __future__ import annotations

from dataclasses import asdict

import torch

from devrf.data.batch import PixelPool, Pixels, RayBatch
from devrf.engine.batches import gather_batch
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import CanonicalRates, Precision
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.adam import GridAdam
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, VoxelOutput
from devrf.scenes.scene import Views
from devrf.system.device import multiplies_bfloat16
from devrf.system.profiling import span

# Rays of a batch at the least, however few pixels there are.
FEWEST_RAYS = 64


class VoxelStage(ScheduledStage):
    """A stage that learns voxel grids.

    Attributes:
        scene_model: the canonical field, its occupancy, and how it deforms.
    """

    scene_model: DeVRFModel

    def __init__(self, iterations_per_step: int, decoder_precision: Precision = "auto") -> None:
        """Build the stage.

        Args:
            iterations_per_step: optimiser iterations in one Lightning step.
            decoder_precision: of the colour network while it learns; ``auto``: as the GPU allows.
        """
        super().__init__(iterations_per_step)
        self.decoder_precision = decoder_precision

    @property
    def field(self) -> DeformationField:
        """The deformation field; what active frames learn may not be written back yet."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @property
    def views(self) -> Views:
        """The images that are learned from, on the stage's device."""
        (images,) = self.images
        return self.training_views(images)

    def draw_pixels(self, pool: PixelPool, most: float | None = None) -> Pixels:
        """Random pixels of a pool: a batch's, at ``most`` so many over all processes."""
        rays = self.loop.rays
        if most is not None:
            rays = min(rays, max(round(most / self.loop.processes), FEWEST_RAYS))
        with span("batch"):
            image, flat = pool.draw(rays, self.generator)
            return Pixels(image, flat, self.background(image))

    def render_pixels(
        self,
        views: Views,
        pixels: Pixels,
        occupancy: Occupancy,
        warp: GridWarp | None = None,
        color_change: ColorChange | None = None,
    ) -> tuple[VoxelOutput, RayBatch]:
        """Render pixels of ``views``."""
        model, chosen = self.scene_model, self.decoder_precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        precision = torch.bfloat16 if reduced else torch.float32
        with span("batch"):
            batch = gather_batch(views, pixels.image, pixels.flat, pixels.background, model.space)
        output = render(
            batch.rays,
            model.canonical,
            occupancy,
            model.settings,
            batch.background,
            warp,
            precision,
            color_change,
        )
        return output, batch


def field_optimizer(field: CanonicalField, rates: CanonicalRates) -> GridAdam:
    """Adam over a field's density, features and decoder, in that order of groups."""
    return GridAdam(
        {
            "params": list(field.get_submodule(name).parameters()),
            "lr": rate,
            "base_lr": rate,
            "name": name,
        }
        for name, rate in asdict(rates).items()
    )

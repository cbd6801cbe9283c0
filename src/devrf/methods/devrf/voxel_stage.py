"""What the stages share: how a batch is drawn and rendered, and how its loss terms are weighed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TypeVar

import torch
from torch import Tensor

from devrf.data.batch import PixelPool, Pixels, RayBatch
from devrf.engine.batches import gather_batch
from devrf.engine.stage import ScheduledStage
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.losses import MotionPrediction, Prediction
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import CanonicalRates, Precision
from devrf.methods.devrf.view import in_lists
from devrf.methods.devrf.volume_rendering import render
from devrf.methods.weighted_loss import visibility, weighted_sum
from devrf.ops.adam import GridAdam
from devrf.ops.dispatch import triton_runs
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import TERMS, photometric_sum
from devrf.rendering.list_rendering import render_static
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, VoxelOutput
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.scenes.scene import Views
from devrf.system.device import multiplies_bfloat16
from devrf.system.graphs import Graphs
from devrf.system.profiling import span

Predicted = TypeVar("Predicted", bound=Prediction)
# Σ weight · term (), and each term's value, by name.
Weighted = tuple[Tensor, dict[str, Tensor]]


class VoxelStage(ScheduledStage):
    """A stage that learns voxel grids.

    Attributes:
        scene_model: the canonical field, its occupancy, and how it deforms.
    """

    scene_model: DeVRFModel

    def __init__(
        self,
        iterations_per_step: int,
        graphs: Graphs = "auto",
        decoder_precision: Precision = "auto",
    ) -> None:
        """Build the stage.

        Args:
            iterations_per_step: optimiser iterations in one Lightning step.
            graphs: whether a GPU replays iterations from CUDA graphs: ``auto`` where it can.
            decoder_precision: what the colour network computes in while it learns; ``auto``:
                ``bfloat16`` on a GPU that multiplies it.
        """
        super().__init__(iterations_per_step, graphs)
        self.decoder_precision = decoder_precision

    @property
    def field(self) -> DeformationField:
        """The deformation field; what active frames learn may not be written back yet."""
        assert self.scene_model.deformation is not None, "the stage has not been set up"
        return self.scene_model.deformation

    @property
    def static_shape(self) -> bool:
        """Whether batches are rendered in lists of fixed length."""
        return in_lists(self.scene_model.space, self.scene_model.canonical)

    def bind(self, rays: int, parameters: Sequence[Sequence[Tensor]]) -> None:
        """Prepare the loop for batches of ``rays`` that teach these parameters each."""
        self.loop.bind(rays, parameters, self.optimizer, static_shape=self.static_shape)

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
        model, chosen = self.scene_model, self.decoder_precision
        reduced = multiplies_bfloat16(self.device) if chosen == "auto" else chosen == "bfloat16"
        precision = torch.bfloat16 if reduced else torch.float32
        with span("batch"):
            batch = gather_batch(views, pixels.image, pixels.flat, pixels.background, model.space)
        fields = model.canonical, occupancy, model.settings, batch.background
        if capacity is None:
            return render(batch.rays, *fields, warp, precision, color_change), batch
        moved = ((), 0.0) if warp is None else (warp.slices, warp.weight)
        listed = render_static(batch.rays, *fields, *moved, capacity, precision, color_change)
        return listed, batch


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


def weighted_loss(
    prediction: Predicted,
    terms: Mapping[str, Callable[[Predicted], Tensor]],
    weights: Mapping[str, float],
) -> Weighted:
    """Σ weight · term (); each term's value and how much rays hit, detached, by name.

    Where Triton runs, kernels compute terms of :mod:`devrf.methods.devrf.losses` together.

    Args:
        prediction: what a batch's rays see, and the truth.
        terms: what can be computed, by name.
        weights: of the terms that count.
    """
    parts: list[Weighted] = []
    output = prediction.output
    if output.first is not None and triton_runs(output.color, output.sample_color):
        parts.append(_photometric(prediction, output.first, weights))
        if isinstance(prediction, MotionPrediction) and not {"cycle", "flow"}.isdisjoint(weights):
            parts += _motion(prediction, weights)
    known = {name for _, values in parts for name in values}
    others = {name: terms[name](prediction) for name in weights if name not in known}
    if others:
        parts.append(weighted_sum(others, weights))
    total, values = parts[0]
    for part, further in parts[1:]:
        total, values = total + part, values | further
    if "opacity" not in values:
        values |= visibility(output.transmittance, prediction.batch.alpha)
    return total, values


def _photometric(prediction: Prediction, first: Tensor, weights: Mapping[str, float]) -> Weighted:
    """The photometric terms of lists in which ray r begins at ``first[r]``, in one kernel."""
    output, batch = prediction.output, prediction.batch
    # The colour's error through a warp is called render.
    names = ["render" if term == "color" and "render" in weights else term for term in TERMS]
    computed = photometric_sum(
        output.color,
        output.transmittance,
        output.weight,
        output.sample_color,
        first,
        batch.color,
        batch.alpha,
        [weights.get(name, 0.0) for name in names],
    )
    each = zip(names, computed.terms.unbind(), strict=True)
    values = {name: value for name, value in each if name in weights}
    values["opacity"] = computed.opacity
    if computed.coverage is not None:
        values["coverage"] = computed.coverage
    return computed.total, values


def _motion(prediction: MotionPrediction, weights: Mapping[str, float]) -> list[Weighted]:
    """Cycle and flow in one kernel; none for warps or spaces that it does not know."""
    output, batch, cameras = prediction.output, prediction.batch, prediction.cameras
    samples, space = output.samples, prediction.space
    unwarp, before = prediction.unwarp, prediction.unwarp_previous
    if not (isinstance(unwarp, GridWarp) and isinstance(before, GridWarp)):
        return []
    ndc = (*space.slopes, space.near) if isinstance(space, NormalizedDevice) else None
    grids = (*unwarp.slices, *before.slices)
    straight = (ndc is not None or space == WORLD) and not unwarp.still_outside
    if samples.present is None or not straight or len(grids) != 2:
        return []
    if not triton_runs(output.canonical, *grids):
        return []
    seen = None
    if "flow" in weights and batch.flow is not None and batch.flow_valid is not None:
        seen = SeenEarlier(
            batch.flow,
            batch.flow_valid,
            batch.pixel,
            batch.image,
            prediction.previous_image,
            cameras.camera_to_world,
            cameras.focal,
            cameras.center,
        )
    computed = motion_sum(
        ListedSamples(
            samples.points, output.canonical, output.weight, samples.ray, samples.present
        ),
        *grids,
        seen,
        (weights.get("cycle", 0.0), weights.get("flow", 0.0)),
        box=unwarp.box,
        over_samples=prediction.flow_mean == "samples",
        ndc=ndc,
    )
    values = zip(("cycle", "flow"), computed.terms.unbind(), strict=True)
    return [(computed.total, {name: value for name, value in values if name in weights})]

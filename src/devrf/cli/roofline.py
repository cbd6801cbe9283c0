"""The least that an iteration has to do: a floor for its time, not a prediction.

Bytes are those that have to pass through the device's memory if every number is read or written
once and nothing is kept from one iteration to the next; floating-point operations are those of
the colour network, which has by far the most. With the corners of a cell (8), float32 (4 bytes),
displacements of three numbers and C features a voxel, an iteration moves

* for each sample tested: the density, 8 · 4, and where it is warped the displacement, 8 · 12;
* for each sample reached, which gets a gradient, a read and a write of it: 8 · 8 of the density
  (canonical stage), or 8 · 24 of the displacement (deformation stage);
* for each heavy sample, whose colour is computed, the features, 8 · 4C, and in the canonical stage
  their gradient, 8 · 8C; with the cycle loss the forward displacement and its gradient, 8 · 36;
  with the flow loss that of the frame before, 8 · 12;
* for each value that Adam steps on 28: itself, its mean and its square, read and written, and its
  gradient, read. In the deformation stage these are the two slices of each visited frame (rays and
  samples, too, are those of all of them together). In the fine part of the canonical stage they
  are the values that got a gradient; counted as four voxels a sample, since samples half a voxel
  apart share half of their corners or more.

The network of widths C → W → W → 3 costs 2·W·(C + W + 3) operations a sample and 2·W·D a ray for
its direction of D numbers; three times that with the gradients of its weights and inputs, twice
where it is frozen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.schedules import CanonicalPhase, DeformationPhase

CORNERS, NUMBER, DISPLACEMENT = 8, 4, 12
# Read, and read and written to be added to.
ONCE, ADDED = 1, 2
ADAM = 28
# Voxels that a sample touches and the one before it on its ray has not.
FRESH = 4


@dataclass(frozen=True)
class Work:
    """What an iteration has to do at least.

    Attributes:
        bytes: through the device's memory.
        operations: in floating point.
    """

    bytes: float
    operations: float

    def seconds(self, bytes_per_second: float, operations_per_second: float) -> float:
        """How long that takes at the device's speeds, one after the other."""
        return self.bytes / bytes_per_second + self.operations / operations_per_second


def roofline(stage: ScheduledStage, counts: Mapping[str, float]) -> Work | None:
    """The least work of an iteration in a stage's present phase.

    Args:
        stage: in the middle of training.
        counts: samples of an iteration that were ``tested``, ``reached`` and ``heavy``.

    Returns:
        None where one of these is not known.
    """
    if not {"tested", "reached", "heavy"} <= counts.keys():
        return None
    tested, reached, heavy = counts["tested"], counts["reached"], counts["heavy"]
    if isinstance(stage, CanonicalStage):
        return _canonical(stage, tested, reached, heavy)
    assert isinstance(stage, DeformationStage)
    return _deformation(stage, tested, reached, heavy)


def _canonical(stage: CanonicalStage, tested: float, reached: float, heavy: float) -> Work:
    assert isinstance(stage.phase, CanonicalPhase)
    field = stage.model.canonical
    density, color = field.density.values, field.color.values
    channels = color.shape[-1]
    looked_up = (
        CORNERS * NUMBER * (ONCE * tested + ADDED * reached + (ONCE + ADDED) * channels * heavy)
    )
    stepped: float = density.numel() + color.numel()
    if stage.phase.kind == "fine":
        stepped = min(density.numel(), FRESH * reached)
        stepped += min(color.numel(), FRESH * heavy * channels)
    learned = decoder_operations(field, stage.schedule.rays, heavy)
    return Work(looked_up + ADAM * stepped, 3 * learned)


def _deformation(stage: DeformationStage, tested: float, reached: float, heavy: float) -> Work:
    field, weights = stage.model.canonical, stage.losses.weights
    channels = field.color.values.shape[-1]
    looked_up = (NUMBER + DISPLACEMENT) * ONCE * tested + DISPLACEMENT * ADDED * reached
    looked_up += NUMBER * channels * ONCE * heavy
    if weights.get("cycle"):
        looked_up += DISPLACEMENT * (ONCE + ADDED) * heavy
    if weights.get("flow"):
        looked_up += DISPLACEMENT * ONCE * heavy
    assert isinstance(stage.phase, DeformationPhase)
    frames = len(stage.phase.frames)
    stepped = 2 * 3 * math.prod(stage.resolution) * frames
    learned = decoder_operations(field, stage.schedule.rays * frames, heavy)
    return Work(CORNERS * looked_up + ADAM * stepped, 2 * learned)


def decoder_operations(field: CanonicalField, rays: float, samples: float) -> float:
    """Operations of the colour network without gradients; none of a field that has no network."""
    decoder = field.decoder
    if not isinstance(decoder, ColorDecoder):
        return 0.0
    layers = (decoder.from_feature, decoder.hidden, decoder.output)
    by_sample = sum(layer.weight.numel() for layer in layers)
    return 2 * (by_sample * samples + decoder.from_direction.weight.numel() * rays)

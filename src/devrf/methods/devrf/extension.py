"""What an extension of the deformation stage may add, and the loss with what it adds.

An extension is one file of ``extensions/`` and one block of ``schedule.extensions``; without both,
all else runs as before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property

from torch import Tensor

from devrf.data.flow import previous_images
from devrf.errors import DevrfError
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_schedule import DeformationPhase, DeformationSchedule
from devrf.methods.devrf.frame_store import FrameField
from devrf.methods.devrf.losses import (
    MOTION_TERMS,
    MotionPrediction,
    apart_from_total_variation,
    total_variation_weight,
)
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.methods.weighted_loss import counted_weights
from devrf.rendering.output import ColorChange
from devrf.scenes.scene import CaptureName

# An unweighted loss term: prediction → ().
MotionTerm = Callable[[MotionPrediction], Tensor]


class MotionStage(VoxelStage):
    """The deformation stage, as extensions see it.

    Attributes:
        schedule: levels, iterations and rays.
        weights: of the loss terms that count at the present level.
        active: the frame that is trained; None before the first, and after the last.
    """

    schedule: DeformationSchedule
    capture: CaptureName = "dynamic"
    weights: dict[str, float]
    active: ActiveFrame | None

    @cached_property
    def previous_images(self) -> Tensor:
        """(N,) for each image the same view's image one frame earlier; itself without one."""
        return previous_images(self.views)


class Extension:
    """Adds to the deformation stage; what is not overridden adds nothing.

    Hooks are called in the order in which they stand here.
    """

    @property
    def terms(self) -> Mapping[str, MotionTerm]:
        """Further loss terms, by name."""
        return {}

    @property
    def weights(self) -> Mapping[str, float]:
        """How much they count, where ``loss.deformation`` does not say."""
        return {}

    @property
    def scaled_terms(self) -> Collection[str]:
        """The loss terms that :meth:`weight_factor` may change."""
        return ()

    def setup(self, stage: MotionStage) -> None:
        """Add fields to the model and groups to the optimiser, before learning starts."""

    def frame_fields(self, stage: MotionStage, level: int) -> Mapping[str, FrameField]:
        """Fields whose frames are learned at ``level`` as the displacements are, by name."""
        return {}

    def begin_level(self, stage: MotionStage, level: int) -> None:
        """Memory of the active frame is ready; give the optimiser what is learned of it."""

    def weight_factor(self, term: str, level: int) -> float:
        """Factor of the weight of any loss term at ``level``."""
        return 1.0

    def initialise(self, stage: MotionStage, phase: DeformationPhase) -> None:
        """Give the phase's frame its first values, in the fields, before a visit."""

    def color_change(self, frame: ActiveFrame) -> ColorChange | None:
        """What is added to the colours' logits of an active frame; None: nothing."""
        return None


class MotionLoss:
    """Σ weight · factor · term, the factors being those of the present level.

    Attributes:
        terms: what can be computed, by name.
    """

    def __init__(
        self,
        loss: Mapping[str, float],
        extensions: Sequence[Extension],
        schedule: DeformationSchedule,
    ) -> None:
        """Merge the weights, and check all names.

        Args:
            loss: weights by the terms' names; ``tv`` is the total variation of both fields.
            extensions: add terms, weights and factors.
            schedule: has a factor for each level, of all terms in ``loss`` but ``render``.

        Raises:
            DevrfError: a weight, or a factor of an extension, is of no term.
        """
        self.terms: dict[str, MotionTerm] = dict(MOTION_TERMS)
        weights, self._tv = apart_from_total_variation(loss, "loss.deformation")
        for extension in extensions:
            self.terms |= extension.terms
            weights |= extension.weights
        self._extensions, self._schedule = extensions, schedule
        self._others = loss.keys() - {"render"}
        self._check_factors()
        self._whole = counted_weights(weights, self.terms, "loss.deformation")

    def _check_factors(self) -> None:
        terms = ", ".join(sorted(self.terms))
        for extension in self._extensions:
            for name in sorted(set(extension.scaled_terms) - self.terms.keys()):
                problem = f"{name} is no term of loss.deformation; the terms are {terms}"
                raise DevrfError(f"schedule.extensions: {problem}")

    def leave_out(self, term: str) -> bool:
        """Let a term count no more; whether it did."""
        return bool(self._whole.pop(term, 0.0))

    def weights_at(self, level: int) -> dict[str, float]:
        """The weights of the terms that count at ``level``."""
        weights = {name: weight * self._factor(name, level) for name, weight in self._whole.items()}
        return {name: weight for name, weight in weights.items() if weight}

    def _factor(self, term: str, level: int) -> float:
        factors = (extension.weight_factor(term, level) for extension in self._extensions)
        of_level = self._schedule.levels[level].other_terms if term in self._others else 1.0
        return math.prod(factors, start=of_level)

    def smoothing(self, level: int, shape: tuple[int, int, int]) -> float:
        """The optimiser's weight of the total variation of grids of ``shape`` at ``level``."""
        weight = self._tv * self._schedule.levels[level].other_terms
        return total_variation_weight(weight, max(shape), self._schedule.rays)

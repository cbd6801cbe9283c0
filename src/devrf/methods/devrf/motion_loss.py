"""The loss of the deformation stage: terms of the paper and of extensions, level by level."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.extension import Extension, MotionTerm
from devrf.methods.devrf.losses import (
    MOTION_TERMS,
    total_variation_weight,
)
from devrf.methods.weighted_loss import counted_weights


class MotionLoss:
    """Σ weight · factor · term, the factors being those of the present level.

    Attributes:
        terms: what can be computed, by name.
        weights: of the terms that count at the present level.
    """

    def __init__(
        self,
        loss: Mapping[str, float],
        extensions: Sequence[Extension],
        schedule: DeformationSchedule,
    ) -> None:
        """Check the weights.

        Args:
            loss: weights by the terms' names; ``tv`` is the total variation of both fields.
            extensions: add terms, weights and factors.
            schedule: has the levels' factors.

        Raises:
            DevrfError: a weight, or a factor of the schedule or an extension, is of no term.
        """
        self.terms: dict[str, MotionTerm] = dict(MOTION_TERMS)
        weights = {name: weight for name, weight in loss.items() if name != "tv"}
        for extension in extensions:
            self.terms |= extension.terms
            weights |= extension.weights
        schedule.check_terms({*self.terms, "tv"})
        for name in (name for extension in extensions for name in extension.scaled_terms):
            if name not in self.terms:
                raise DevrfError(
                    f"schedule.extensions: {name} is no term of loss.deformation; the terms are "
                    f"{', '.join(sorted(self.terms))}"
                )
        self._whole = counted_weights(weights, self.terms, "loss.deformation")
        self._tv = loss.get("tv", 0.0)
        self._extensions, self._schedule = extensions, schedule
        self.weights: Mapping[str, float] = self._whole

    def leave_out(self, term: str) -> None:
        """Let a term count no more."""
        self._whole = {name: weight for name, weight in self._whole.items() if name != term}

    def begin_level(self, level: int) -> None:
        """Give each term its weight at ``level``."""
        weights = {name: weight * self._factor(name, level) for name, weight in self._whole.items()}
        self.weights = {name: weight for name, weight in weights.items() if weight}

    def _factor(self, term: str, level: int) -> float:
        factors = (extension.weight_factor(term, level) for extension in self._extensions)
        return math.prod(factors, start=self._schedule.weight_factor(term, level))

    def smoothing(self, level: int, shape: tuple[int, int, int]) -> float:
        """The optimiser's weight of the total variation of grids of ``shape`` at ``level``."""
        weight = self._tv * self._schedule.weight_factor("tv", level)
        return total_variation_weight(weight, max(shape), self._schedule.rays)

"""The deformation stage's loss: its terms and their weights at each level."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.extension import Extension
from devrf.methods.devrf.losses import (
    DEFORMATION_TERMS,
    DeformationTerm,
    apart_from_total_variation,
    total_variation_weight,
)
from devrf.methods.weighted_loss import counted_weights


class DeformationLoss:
    """Weights of Σ weight · factor · term; the factors are those of a level.

    Attributes:
        terms: all terms, by name.
        unit: the length in world units that ``cycle`` and ``tv`` count as 1
            (docs/method.md#deformation-learning-rate).
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
        self.unit = 1.0
        self.terms: dict[str, DeformationTerm] = dict(DEFORMATION_TERMS)
        weights, self._total_variation = apart_from_total_variation(loss, "loss.deformation")
        for extension in extensions:
            self.terms |= extension.terms
            weights = {**extension.weights, **weights}
        names = ", ".join(sorted(self.terms))
        for extension in extensions:
            for name in sorted(set(extension.scaled_terms) - self.terms.keys()):
                raise DevrfError(
                    f"schedule.extensions: {name} is no term of loss.deformation; the terms are "
                    f"{names}"
                )
        self._weights = counted_weights(weights, self.terms, "loss.deformation")
        self._scaled_by_level = loss.keys() - {"render"}
        self._extensions = extensions
        self._schedule = schedule

    def leave_out(self, term: str) -> bool:
        """Let a term count no more; return whether it did."""
        return bool(self._weights.pop(term, 0.0))

    def weights_at(self, level: int, share: float = 0.0) -> dict[str, float]:
        """The weights of the terms that count at ``level``, a ``share`` of a visit being over."""
        weights = {
            name: weight * self._factor(name, level, share)
            for name, weight in self._weights.items()
        }
        return {name: weight for name, weight in weights.items() if weight}

    def _factor(self, term: str, level: int, share: float) -> float:
        scaled = term in self._scaled_by_level
        of_level = self._schedule.levels[level].other_terms if scaled else 1.0
        if term == "cycle":
            of_level /= self.unit**2
        factors = (extension.weight_factor(term, level, share) for extension in self._extensions)
        return math.prod(factors, start=of_level)

    def smoothing(self, level: int, shape: tuple[int, int, int]) -> float:
        """The optimiser's weight of the total variation of grids of ``shape`` at ``level``."""
        weight = self._total_variation * self._schedule.levels[level].other_terms / self.unit**2
        return total_variation_weight(weight, max(shape), self._schedule.rays)

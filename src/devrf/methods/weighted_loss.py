"""Weighs loss terms and adds them up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from devrf.errors import DevrfError

Prediction = TypeVar("Prediction")
Terms = Mapping[str, Callable[[Prediction], Tensor]]


@dataclass(frozen=True)
class WeightedLoss(Generic[Prediction]):
    """Σ weight · term over the terms whose weight is not zero; the others are not computed.

    Attributes:
        terms: what can be computed, by name: prediction → unweighted scalar.
        weights: how much each counts.
    """

    terms: Terms[Prediction]
    weights: Mapping[str, float]

    def __post_init__(self) -> None:
        unknown = sorted(set(self.weights) - set(self.terms))
        if unknown:
            known = ", ".join(sorted(self.terms))
            raise DevrfError(f"loss: unknown term {unknown[0]!r}; the terms are {known}")

    def __call__(self, prediction: Prediction) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum, and each term's unweighted value by name, detached."""
        values = {
            name: self.terms[name](prediction) for name, weight in self.weights.items() if weight
        }
        total = sum((self.weights[name] * value for name, value in values.items()), start=0.0)
        if not isinstance(total, Tensor):
            raise DevrfError("loss: every weight is zero; at least one term must count")
        return total, {name: value.detach() for name, value in values.items()}

"""The weighted sum of a loss's terms; several of them in one pass where Triton runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeGuard, TypeVar

import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.losses import (
    FLOW_TERMS,
    PHOTOMETRIC_TERMS,
    MotionPrediction,
    Prediction,
    coverage,
    cycle,
    opacity,
)
from devrf.methods.devrf.volume_rendering import Warp
from devrf.ops.dispatch import triton_runs
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import TERMS, photometric_sum

Predicted = TypeVar("Predicted")
# Weights of the terms that count, by their function.
Counted = Mapping[object, float]
# A weighted sum, and unweighted values by their function: of its terms, and of what is logged.
Fused = tuple[Tensor, dict[object, Tensor]]


@dataclass(frozen=True)
class WeightedLoss(Generic[Predicted]):
    """Σ weight · term over the terms whose weight is not zero; the others are not computed.

    Attributes:
        terms: what can be computed, by name: prediction → unweighted scalar.
        weights: how much each counts.
        logged: what is reported beside them, without gradients: prediction → scalar, or None where
            there is no such thing.
    """

    terms: Mapping[str, Callable[[Predicted], Tensor]]
    weights: Mapping[str, float]
    logged: Mapping[str, Callable[[Predicted], Tensor | None]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = sorted(set(self.weights) - set(self.terms))
        if unknown:
            known = ", ".join(sorted(self.terms))
            raise DevrfError(f"loss: unknown term {unknown[0]!r}; the terms are {known}")

    def __call__(self, prediction: Predicted) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum; each term's unweighted value, and what is logged, by name, detached."""
        counted = {name: weight for name, weight in self.weights.items() if weight}
        names: dict[object, str] = {self.terms[name]: name for name in counted}
        by_term = {term: counted[name] for term, name in names.items()}
        total: Tensor | float = 0.0
        known: dict[object, Tensor] = {}
        for fuse in (photometric_terms, motion_terms):
            fused = fuse(prediction, by_term) if isinstance(prediction, Prediction) else None
            if fused is not None:
                total = fused[0] + total if known else fused[0]
                known |= fused[1]
        values = {name: known[term] for term, name in names.items() if term in known}
        apart = {name: self.terms[name](prediction) for name in counted if name not in values}
        for name, value in apart.items():
            total = total + counted[name] * value
            values[name] = value.detach()
        if not isinstance(total, Tensor):
            raise DevrfError("loss: every weight is zero; at least one term must count")
        with torch.no_grad():
            for name, measure in self.logged.items():
                measured = known[measure] if measure in known else measure(prediction)
                if measured is not None:
                    values[name] = measured
        return total, values


def photometric_terms(prediction: Prediction, counted: Counted) -> Fused | None:
    """The photometric terms and the rays' visibility, where one kernel computes them all."""
    output, batch = prediction.output, prediction.batch
    if output.first is None or not triton_runs(output.color, output.sample_color):
        return None
    functions = [PHOTOMETRIC_TERMS[name] for name in TERMS]
    found = photometric_sum(
        output.color,
        output.transmittance,
        output.weight,
        output.sample_color,
        output.first,
        batch.color,
        batch.alpha,
        [counted.get(term, 0.0) for term in functions],
    )
    each = zip(functions, found.terms.unbind(), strict=True)
    values: dict[object, Tensor] = {term: value for term, value in each if term in counted}
    values[opacity] = found.opacity
    if found.coverage is not None:
        values[coverage] = found.coverage
    return found.total, values


def motion_terms(prediction: Prediction, counted: Counted) -> Fused | None:
    """Cycle and flow, where one kernel computes both."""
    mean = next((mean for mean, term in FLOW_TERMS.items() if term in counted), None)
    if not isinstance(prediction, MotionPrediction) or (mean is None and cycle not in counted):
        return None
    output, batch, cameras = prediction.output, prediction.batch, prediction.cameras
    samples, space = output.samples, prediction.space
    unwarp, unwarp_previous = prediction.unwarp, prediction.unwarp_previous
    if samples.present is None or not (_of_one_grid(unwarp) and _of_one_grid(unwarp_previous)):
        return None
    (forward,), (before,), box = unwarp.slices, unwarp_previous.slices, unwarp.box
    ndc = (*space.slopes, space.near) if isinstance(space, NormalizedDevice) else None
    if (ndc is None and space != WORLD) or not triton_runs(output.canonical, forward, before):
        return None
    seen = None
    if mean is not None and batch.flow is not None and batch.flow_valid is not None:
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
    found = motion_sum(
        ListedSamples(
            samples.points, output.canonical, output.weight, samples.ray, samples.present
        ),
        forward,
        before,
        seen,
        (counted.get(cycle, 0.0), 0.0 if mean is None else counted[FLOW_TERMS[mean]]),
        box=box,
        over_samples=mean == "samples",
        ndc=ndc,
    )
    values: dict[object, Tensor] = {cycle: found.terms[0]} if cycle in counted else {}
    if mean is not None:
        values[FLOW_TERMS[mean]] = found.terms[1]
    return found.total, values


def _of_one_grid(warp: Warp) -> TypeGuard[GridWarp]:
    """Whether the warp is what a kernel computes: a grid's, also outside its box."""
    return isinstance(warp, GridWarp) and len(warp.slices) == 1 and not warp.still_outside

"""The weighted sum of loss terms; where Triton runs, kernels compute several terms together.

What the terms are is said in :mod:`devrf.methods.devrf.losses`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeGuard, TypeVar

from torch import Tensor

from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.losses import MotionPrediction, Prediction
from devrf.methods.devrf.volume_rendering import Warp
from devrf.methods.weighted_loss import visibility, weighted_sum
from devrf.ops.dispatch import triton_runs
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import TERMS, photometric_sum

Predicted = TypeVar("Predicted", bound=Prediction)
# Σ weight · term (), and each term's value, by name.
Weighted = tuple[Tensor, dict[str, Tensor]]


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
    parts = _fused(prediction, weights)
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


def _fused(prediction: Prediction, weights: Mapping[str, float]) -> list[Weighted]:
    """The terms that kernels compute, of those that ``weights`` names."""
    output = prediction.output
    if output.first is None or not triton_runs(output.color, output.sample_color):
        return []
    parts = [_photometric(prediction, output.first, weights)]
    if isinstance(prediction, MotionPrediction) and not {"cycle", "flow"}.isdisjoint(weights):
        motion = _motion(prediction, weights)
        parts += [] if motion is None else [motion]
    return parts


def _photometric(prediction: Prediction, first: Tensor, weights: Mapping[str, float]) -> Weighted:
    output, batch = prediction.output, prediction.batch
    names = [_name_in(weights, term) for term in TERMS]
    found = photometric_sum(
        output.color,
        output.transmittance,
        output.weight,
        output.sample_color,
        first,
        batch.color,
        batch.alpha,
        [weights.get(name, 0.0) for name in names],
    )
    each = zip(names, found.terms.unbind(), strict=True)
    values = {name: value for name, value in each if name in weights} | {"opacity": found.opacity}
    return found.total, values if found.coverage is None else values | {"coverage": found.coverage}


def _name_in(weights: Mapping[str, float], term: str) -> str:
    """What the weights call a photometric term: the colour's error through a warp is ``render``."""
    return "render" if term == "color" and "render" in weights else term


def _motion(prediction: MotionPrediction, weights: Mapping[str, float]) -> Weighted | None:
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
    found = motion_sum(
        ListedSamples(
            samples.points, output.canonical, output.weight, samples.ray, samples.present
        ),
        forward,
        before,
        seen,
        (weights.get("cycle", 0.0), weights.get("flow", 0.0)),
        box=box,
        over_samples=prediction.flow_mean == "samples",
        ndc=ndc,
    )
    values = zip(("cycle", "flow"), found.terms.unbind(), strict=True)
    return found.total, {name: value for name, value in values if name in weights}


def _of_one_grid(warp: Warp) -> TypeGuard[GridWarp]:
    """Whether the warp is what a kernel computes: a grid's, also outside its box."""
    return isinstance(warp, GridWarp) and len(warp.slices) == 1 and not warp.still_outside

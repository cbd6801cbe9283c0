"""Loss terms that a kernel computes together, where Triton runs; ``losses`` says what they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeGuard

from torch import Tensor

from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.methods.devrf.losses import MotionPrediction, Prediction
from devrf.methods.devrf.volume_rendering import Warp
from devrf.ops.dispatch import triton_runs
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import TERMS, photometric_sum

# Σ weight · term (), and each term's value, by name.
Weighted = tuple[Tensor, dict[str, Tensor]]


def fused_losses(
    prediction: Prediction, first: Tensor, weights: Mapping[str, float]
) -> list[Weighted]:
    """The weighted sums of the terms that kernels compute, of those that ``weights`` names.

    Args:
        prediction: what a batch's rays see, in lists of fixed length.
        first: (R + 1,) where each ray's samples begin.
        weights: of the terms that count.
    """
    parts = [_photometric(prediction, first, weights)]
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

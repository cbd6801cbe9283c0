"""The losses: terms and weighted sums (docs/method.md#photometric-losses, #deformation-losses)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD, Space
from devrf.kernels.deformation import cycle_error, flow_error
from devrf.kernels.photometric import photometric
from devrf.kernels.runtime import is_supported
from devrf.methods.devrf.deformation_field import GridWarp, Warp
from devrf.methods.weighted_loss import visibility, weighted_sum
from devrf.ops.photometric import (
    TERMS,
    alpha_mask_error,
    background_entropy,
    color_error,
    per_sample_color,
)
from devrf.rendering.output import VoxelOutput

# The flow loss is a mean over these.
FlowMean = Literal["rays", "samples"]
# Σ weight · term (), and each term's value, by name.
Weighted = tuple[Tensor, dict[str, Tensor]]


@dataclass(frozen=True)
class Prediction:
    """The render of a batch's rays, and the truth at their pixels."""

    output: VoxelOutput
    batch: RayBatch


Predicted = TypeVar("Predicted", bound=Prediction)

# Terms that compare rays with images; the equations are in devrf.ops.photometric.
PHOTOMETRIC_TERMS: dict[str, Callable[[Prediction], Tensor]] = {
    "render": lambda seen: color_error(seen.output.color, seen.batch.color, seen.batch.per_pixel),
    "per_sample_color": lambda seen: per_sample_color(
        seen.output.samples.weight,
        seen.output.sample_color,
        seen.output.samples.ray,
        seen.batch.color,
    ),
    "entropy": lambda seen: background_entropy(seen.output.transmittance),
    "alpha_mask": lambda seen: alpha_mask_error(
        seen.output.transmittance, seen.batch.alpha, seen.batch.per_pixel
    ),
}


@dataclass(frozen=True)
class DeformationPrediction(Prediction):
    """A prediction through the backward warp of one frame t, with the deformation terms' inputs.

    Attributes:
        forward_warp: canonical points q (M, 3) → q + Δ_f(q, t).
        previous_forward_warp: q → q + Δ_f(q, t − 1), frozen.
        cameras: the cameras of the images that the batch was drawn from.
        previous_image: (N,) int64, for each image the same view's one frame earlier, or itself.
        forward_slice: (X, Y, Z, 3) Δ_f(·, t) itself, for terms that need no samples.
        box: of the slices.
        space: of the points.
        flow_mean: whether the flow loss is a mean over rays or samples.
    """

    forward_warp: Warp
    previous_forward_warp: Warp
    cameras: Cameras
    previous_image: Tensor
    forward_slice: Tensor
    box: Box
    space: Space = WORLD
    flow_mean: FlowMean = "samples"


def cycle(prediction: DeformationPrediction) -> Tensor:
    """L_cycle = mean_i ½ |x_i − (q_i + Δ_f(q_i, t))|² (docs/method.md#cycle)."""
    samples, warp = prediction.output.samples, prediction.forward_warp
    if (
        isinstance(warp, GridWarp)
        and warp.displacement is not None
        and is_supported(samples.weight)
    ):
        outside = warp.zero_outside_box
        return cycle_error(samples, warp.displacement, warp.box, zero_outside_box=outside)
    missed = samples.points - warp(samples.canonical)
    error = 0.5 * missed.square().sum(dim=1)
    return error.mean() if len(error) else error.sum()


def flow(prediction: DeformationPrediction) -> Tensor:
    """L_flow = (1/M) Σ_i w_i m_i |φ_i − φ_i^observed|₁ in pixels (docs/method.md#flow).

    M is the number of ``rays`` whose flow is valid, or twice the number of their ``samples``.
    0 without observed flow.
    """
    batch, samples = prediction.batch, prediction.output.samples
    valid = batch.flow_valid
    if batch.flow is None or valid is None:
        return samples.weight.new_zeros(())
    warp, space = prediction.previous_forward_warp, prediction.space
    if isinstance(warp, GridWarp) and space.is_linear and is_supported(samples.weight):
        return flow_error(
            samples,
            warp.displacement,
            warp.box,
            zero_outside_box=warp.zero_outside_box,
            cameras=prediction.cameras,
            previous=prediction.previous_image,
            image=batch.image,
            pixel=batch.pixel,
            flow=batch.flow,
            valid=valid,
            ndc=space if isinstance(space, NormalizedDevice) else None,
            by_ray=prediction.flow_mean == "rays",
        )
    ray = samples.ray
    induced = induced_flow(
        samples.canonical,
        warp,
        prediction.cameras,
        prediction.previous_image[batch.image][ray],
        batch.pixel[ray],
        space,
    )
    error = torch.where(valid[ray], (induced - batch.flow[ray]).abs().sum(dim=1), 0.0)
    count = valid.sum() if prediction.flow_mean == "rays" else 2 * valid[ray].sum()
    return (samples.weight * error).sum() / count.clamp(min=1)


def induced_flow(
    canonical: Tensor,
    forward_warp: Warp,
    cameras: Cameras,
    camera: Tensor,
    pixel: Tensor,
    space: Space = WORLD,
) -> Tensor:
    """φ = π(q + Δ_f(q, t − 1)) − u (M, 2) in pixels, the flow that the deformation implies.

    Args:
        canonical: (M, 3) canonical positions q.
        forward_warp: q → q + Δ_f(q, t − 1), of the earlier frame.
        cameras: all cameras.
        camera: (M,) int64, the camera π that took the earlier frame.
        pixel: (M, 2) u, the points' pixels now: x, y in pixels.
        space: of the points.
    """
    position, _ = cameras.project(camera, space.to_world(forward_warp(canonical)))
    return position - pixel


def apart_from_total_variation(
    loss: Mapping[str, float], key: str
) -> tuple[dict[str, float], float]:
    """The weights of a loss's other terms by name, and ω of its total variation ``tv``.

    Raises:
        DevrfError: ω, of config key ``key``.tv, is negative.
    """
    weights = dict(loss)
    weight = weights.pop("tv", 0.0)
    expect(weight >= 0, f"{key}.tv", "at least 0", weight)
    return weights, weight


def total_variation_weight(weight: float, side: int, rays: int) -> float:
    """ω · (side / 128) / (6R): factor of Σ clamp(v − v', −1, 1) (docs/method.md#total-variation).

    R ``rays``, ω the term's ``weight``; the side is the grid's longest, in NDC across its planes.
    The optimiser adds this gradient, not autograd.
    """
    return weight * (side / 128) / rays / 6


# An unweighted loss term: prediction → ().
DeformationTerm = Callable[[DeformationPrediction], Tensor]
# The paper's terms that constrain the deformation, and the photometric ones of the warped render.
DEFORMATION_TERMS: dict[str, DeformationTerm] = {
    **PHOTOMETRIC_TERMS,
    "cycle": cycle,
    "flow": flow,
}


def batch_loss(
    prediction: Predicted,
    terms: Mapping[str, Callable[[Predicted], Tensor]],
    weights: Mapping[str, float],
) -> Weighted:
    """Σ weight · term () over ``weights``; each term's value and the visibility, detached."""
    output, batch = prediction.output, prediction.batch
    # A kernel has the terms that compare rays with images together.
    together = {
        name: weight
        for name, weight in weights.items()
        if name in TERMS and terms[name] is PHOTOMETRIC_TERMS[name] and is_supported(output.color)
    }
    others = {name: terms[name](prediction) for name in weights if name not in together}
    if not together:
        total, values = weighted_sum(others, weights)
        return total, values | visibility(output.transmittance, batch.alpha)
    total, values = photometric(
        output.samples,
        output.sample_color,
        output.background,
        output.color,
        batch.color,
        batch.alpha,
        together,
        batch.per_pixel,
    )
    for name, value in others.items():
        total = torch.add(total, value, alpha=weights[name])
    return total, values | {name: value.detach() for name, value in others.items()}

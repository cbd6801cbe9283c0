"""Volume rendering of a canonical field, seen through a warp or as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.ops.compositing import composite, sum_by_ray, transmittances
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import Samples, march
from devrf.system.profiling import span

Warp = Callable[[Tensor], Tensor]

# A ray ends where less than this of it is left: what is behind cannot be seen.
STOP = 1e-4


@dataclass(frozen=True)
class RenderSettings:
    """How finely rays are sampled and what is too faint to matter.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples with a lower opacity are dropped, then samples with a lower
            weight, before their colour is computed.
        near: distance before which nothing is sampled, in world units (or NDC).
        far: distance behind which nothing is sampled, likewise.
    """

    step: float
    alpha_threshold: float
    near: float
    far: float


@dataclass(frozen=True)
class RenderOutput:
    """What R rays see.

    Attributes:
        color: (R, 3) RGB, composited on the background.
        depth: (R,) mean distance of what is seen along the ray; 0 where nothing is.
        transmittance: (R,) what is left of the ray behind the last sample, T_end.
        samples: the K samples whose colour was computed, at their own positions.
        canonical: (K, 3) positions of the samples in canonical space.
        weight: (K,) their weights.
        sample_color: (K, 3) their colours.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor
    samples: Samples
    canonical: Tensor
    weight: Tensor
    sample_color: Tensor


def render(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: Warp | None = None,
    precision: torch.dtype = torch.float32,
) -> RenderOutput:
    """Colours and depths of rays: C = Σ w_i c_i + T_end · background (method §2).

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind everything.
        warp: maps the rays' points (M, 3) into canonical space; None leaves them.
        precision: what the colour network works in.

    Returns:
        What the rays see; differentiable in the field's and the warp's parameters.
    """
    delta = field.step_in_base_voxels(settings.step)
    with span("sampling"):
        samples = march(
            rays,
            field.box,
            occupancy,
            step=field.step_length(settings.step),
            near=settings.near,
            far=settings.far,
        )
    # Most samples turn out to be empty or hidden. That is found out without a graph, so that
    # gradients are computed for the others only.
    with torch.no_grad():
        samples, canonical, tau = _visible(samples, field, delta, settings.alpha_threshold, warp)
    if torch.is_grad_enabled():
        canonical = _warped(samples, warp)
        with span("density"):
            tau = field.optical_depth(canonical, delta)
    with span("compositing"):
        weight, transmittance = composite(tau, samples.ray, len(rays))
    with span("sampling"):
        heavy = _at_least(weight.detach(), settings.alpha_threshold)
        samples, canonical = samples[heavy], canonical.index_select(0, heavy)
        weight = weight.index_select(0, heavy)
    with span("decoder"):
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision)
    with span("compositing"):
        seen = sum_by_ray(weight[:, None] * color, samples.ray, len(rays))
        with torch.no_grad():
            mass = sum_by_ray(weight, samples.ray, len(rays))
            depth = sum_by_ray(weight * samples.distance, samples.ray, len(rays))
    return RenderOutput(
        color=seen + transmittance[:, None] * background,
        depth=depth / mass.clamp(min=1e-6),
        transmittance=transmittance,
        samples=samples,
        canonical=canonical,
        weight=weight,
        sample_color=color,
    )


def _visible(
    samples: Samples, field: CanonicalField, delta: float, threshold: float, warp: Warp | None
) -> tuple[Samples, Tensor, Tensor]:
    """The samples that are neither empty nor hidden, their canonical positions, and their τ."""
    canonical = _warped(samples, warp)
    with span("density"):
        tau = field.optical_depth(canonical, delta)
    with span("sampling"):
        opaque = _at_least(-torch.expm1(-tau), threshold)
        ray, tau = samples.ray.index_select(0, opaque), tau.index_select(0, opaque)
    with span("compositing"):
        left = transmittances(tau, ray, samples.rays)
    with span("sampling"):
        reached = _at_least(left, STOP)
        kept = opaque.index_select(0, reached)
        return samples[kept], canonical.index_select(0, kept), tau.index_select(0, reached)


def _warped(samples: Samples, warp: Warp | None) -> Tensor:
    if warp is None:
        return samples.points
    with span("warp"):
        return warp(samples.points)


def _at_least(values: Tensor, threshold: float) -> Tensor:
    return (values >= threshold).nonzero()[:, 0]

"""Volume rendering of a canonical field, at rest or through a warp.

The samples of each ray, docs/method.md#rays, composited: docs/method.md#compositing.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.ops.compositing import color_and_depth, composite, sum_by_ray, transmittances
from devrf.rendering.front_to_back import behind
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, VoxelOutput
from devrf.rendering.sampling import STOP, RenderSettings, Samples, march
from devrf.system.profiling import span

Warp = Callable[[Tensor], Tensor]


def render(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: Warp | None = None,
    precision: torch.dtype = torch.float32,
    color_change: ColorChange | None = None,
) -> VoxelOutput:
    """Colours Ĉ = Σ w_i c_i + T_end · C_background and depths Σ w_i z_i / Σ w_i of rays.

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind all; the field's own where the space holds infinity.
        warp: x → q = x + Δ_b(x, t), points (M, 3) to canonical space; None is the identity.
        precision: what the colour network works in.
        color_change: q → A_t(q), added to the colours' logits; None: nothing is.

    Returns:
        What the rays see; differentiable in the parameters of field, warp and colour change.
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
    # Most samples are empty or hidden. A first pass without gradients leaves them out; a second
    # warps the others again, since its results have a graph to the warp and the field.
    with torch.no_grad():
        samples, canonical, tau = _visible(samples, field, delta, settings.alpha_threshold, warp)
    if torch.is_grad_enabled():
        canonical, tau = _optical_depths(samples, field, delta, warp)
    with span("compositing"):
        weight, transmittance = composite(tau, samples.ray, len(rays))
    with span("sampling"):
        significant = _at_least(weight.detach(), settings.alpha_threshold)
        samples, canonical = samples[significant], canonical.index_select(0, significant)
        weight = weight.index_select(0, significant)
    with span("decoder"):
        residual = None if color_change is None else color_change(canonical)
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision, residual)
        background = behind(rays, field, background, precision)
    with span("compositing"):
        seen = sum_by_ray(weight[:, None] * color, samples.ray, len(rays))
        with torch.no_grad():
            mass = sum_by_ray(weight, samples.ray, len(rays))
            reached = sum_by_ray(weight * samples.distance, samples.ray, len(rays))
        image, depth = color_and_depth(seen, reached, mass, transmittance, background)
    return VoxelOutput(
        color=image,
        depth=depth,
        transmittance=transmittance,
        samples=samples,
        canonical=canonical,
        weight=weight,
        sample_color=color,
        residual=residual,
    )


def _visible(
    samples: Samples, field: CanonicalField, delta: float, threshold: float, warp: Warp | None
) -> tuple[Samples, Tensor, Tensor]:
    """The samples that are neither empty nor hidden, their canonical positions, and their τ."""
    canonical, tau = _optical_depths(samples, field, delta, warp)
    with span("sampling"):
        opaque = _at_least(-torch.expm1(-tau), threshold)
        ray, tau = samples.ray.index_select(0, opaque), tau.index_select(0, opaque)
    with span("compositing"):
        left = transmittances(tau, ray, samples.rays)
    with span("sampling"):
        reached = _at_least(left, STOP)
        kept = opaque.index_select(0, reached)
        return samples[kept], canonical.index_select(0, kept), tau.index_select(0, reached)


def _optical_depths(
    samples: Samples, field: CanonicalField, delta: float, warp: Warp | None
) -> tuple[Tensor, Tensor]:
    """Canonical positions of samples, and their τ."""
    canonical = samples.points
    if warp is not None:
        with span("warp"):
            canonical = warp(canonical)
    with span("density"):
        return canonical, field.optical_depth(canonical, delta)


def _at_least(values: Tensor, threshold: float) -> Tensor:
    return (values >= threshold).nonzero()[:, 0]

"""Volume rendering of a canonical field, at rest or through a warp.

The samples of each ray, docs/method.md#rays, composited: docs/method.md#compositing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.appearance import ColorResidual
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.settings import RenderSettings
from devrf.ops.compositing import color_and_depth, composite, sum_by_ray, transmittances
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import RenderOutput
from devrf.rendering.sampling import Samples, march
from devrf.system.profiling import span

Warp = Callable[[Tensor], Tensor]

# A ray ends where its transmittance is less: what is behind cannot be seen.
STOP = 1e-4


@dataclass(frozen=True, kw_only=True)
class VoxelOutput(RenderOutput):
    """What R rays see, and the K samples whose colour was computed.

    Attributes:
        samples: at their positions x_i at the rays' time.
        canonical: (K, 3) their canonical positions q_i.
        weight: (K,) their weights w_i.
        sample_color: (K, 3) their colours c_i.
        residual: (K, 3) A_t(q_i) in logits; None without one.
        first: (R + 1,) where each ray's samples begin in a list of fixed length; None elsewhere.
    """

    samples: Samples
    canonical: Tensor
    weight: Tensor
    sample_color: Tensor
    residual: Tensor | None = None
    first: Tensor | None = None

    def mean_over_samples(self, values: Tensor) -> Tensor:
        """The mean () of values (K,) of samples, padding left out; 0 without samples."""
        present = self.samples.present
        if present is not None:
            return torch.where(present, values, 0.0).sum() / present.sum().clamp(min=1)
        return values.mean() if len(values) else values.sum()

    def count_on(self, chosen: Tensor) -> Tensor:
        """The number () of samples on the ``chosen`` (R,) rays, padding left out."""
        kept, present = chosen[self.samples.ray], self.samples.present
        return kept.sum() if present is None else (kept & present).sum()

    def on_rays(self, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ray (S,), canonical position (S, 3) and weight (S,) of the ``chosen`` (R,) rays' samples.

        A list of fixed length keeps its length: other samples get weight 0 and a harmless position.
        """
        ray, kept = self.samples.ray, chosen[self.samples.ray]
        if self.samples.present is None:
            index = kept.nonzero()[:, 0]
            return ray[index], self.canonical[index], self.weight[index]
        kept = kept & self.samples.present
        canonical = torch.where(kept[:, None], self.canonical, 0.0)
        return ray, canonical, torch.where(kept, self.weight, 0.0)


def render(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: Warp | None = None,
    precision: torch.dtype = torch.float32,
    appearance: ColorResidual | None = None,
) -> VoxelOutput:
    """Colours Ĉ = Σ w_i c_i + T_end · C_background and depths Σ w_i z_i / Σ w_i of rays.

    Where the fields' space holds infinity, the field's colour there is what rays end in.

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind everything, if the space does not hold infinity.
        warp: x → q = x + Δ_b(x, t), points (M, 3) to canonical space; None is the identity.
        precision: what the colour network works in.
        appearance: q → A_t(q), added to the colours' logits; None: nothing is.

    Returns:
        What the rays see; differentiable in the parameters of field, warp and appearance.
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
    # Most samples are empty or hidden. They are left out before the graph is built, so that
    # gradients are computed for the others alone.
    with torch.no_grad():
        samples, canonical, tau = _visible(samples, field, delta, settings.alpha_threshold, warp)
    if torch.is_grad_enabled():
        canonical = _warped(samples, warp)
        with span("density"):
            tau = field.optical_depth(canonical, delta)
    with span("compositing"):
        weight, transmittance = composite(tau, samples.ray, len(rays))
    with span("sampling"):
        significant = _at_least(weight.detach(), settings.alpha_threshold)
        samples, canonical = samples[significant], canonical.index_select(0, significant)
        weight = weight.index_select(0, significant)
    with span("decoder"):
        residual = None if appearance is None else appearance(canonical)
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision, residual)
        ends = rays.ends()
        if ends is not None:
            every = torch.arange(len(rays), device=ends.device)
            background = field.rgb(ends, rays.viewdirs, every, precision)
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

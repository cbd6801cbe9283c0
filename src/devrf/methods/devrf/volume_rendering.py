"""Volume rendering of a canonical field, seen through a warp or as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.settings import RenderSettings
from devrf.ops.compositing import composite, sum_by_ray, transmittances
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import RenderOutput
from devrf.rendering.sampling import Samples, march
from devrf.system.profiling import span

Warp = Callable[[Tensor], Tensor]

# A ray ends where less than this of it is left: what is behind cannot be seen.
STOP = 1e-4


@dataclass(frozen=True)
class Segments:
    """S samples of a render, those of some rays alone; what lies elsewhere has no weight.

    Attributes:
        ray: (S,) int64, the ray of each sample.
        canonical: (S, 3) positions in canonical space.
        weight: (S,) rendering weights.
    """

    ray: Tensor
    canonical: Tensor
    weight: Tensor


@dataclass(frozen=True, kw_only=True)
class VoxelOutput(RenderOutput):
    """What R rays see, and the samples that they see it by.

    Attributes:
        samples: the K samples whose colour was computed, at their own positions.
        canonical: (K, 3) positions of the samples in canonical space.
        weight: (K,) their weights.
        sample_color: (K, 3) their colours.
    """

    samples: Samples
    canonical: Tensor
    weight: Tensor
    sample_color: Tensor

    def mean_over_samples(self, values: Tensor) -> Tensor:
        """The mean () of values (K,) of samples; 0 without samples, differentiable all the same."""
        present = self.samples.present
        if present is not None:
            # A list of fixed length: padding counts for nothing.
            return torch.where(present, values, 0.0).sum() / present.sum().clamp(min=1)
        return values.mean() if len(values) else values.sum()

    def on_rays(self, chosen: Tensor) -> Segments:
        """The samples of the ``chosen`` rays, (R,) bool."""
        ray, counts = self.samples.ray, chosen[self.samples.ray]
        if self.samples.present is None:
            kept = counts.nonzero()[:, 0]
            return Segments(ray[kept], self.canonical[kept], self.weight[kept])
        # A list of fixed length stays as long as it is: what does not count is made harmless,
        # wherever it lies.
        counts = counts & self.samples.present
        canonical = torch.where(counts[:, None], self.canonical, 0.0)
        return Segments(ray, canonical, torch.where(counts, self.weight, 0.0))


def joined(outputs: Sequence[VoxelOutput], places: Sequence[Tensor]) -> VoxelOutput:
    """What some renders see as that of one batch.

    Args:
        outputs: of the rays at ``places[k]``, in lists as long as need be.
        places: (R_k,) int64, where in the batch the rays of each output stand; together all.
    """
    if len(outputs) == 1:
        return outputs[0]
    back = torch.cat(list(places)).argsort()
    rays = len(back)
    ray = torch.cat([place[one.samples.ray] for one, place in zip(outputs, places, strict=True)])
    order = ray.argsort(stable=True)

    def per_ray(name: str) -> Tensor:
        return torch.cat([getattr(one, name) for one in outputs])[back]

    def per_sample(values: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(values))[order]

    samples = Samples(
        ray[order],
        per_sample([one.samples.distance for one in outputs]),
        per_sample([one.samples.points for one in outputs]),
        rays,
    )
    return VoxelOutput(
        color=per_ray("color"),
        depth=per_ray("depth"),
        transmittance=per_ray("transmittance"),
        samples=samples,
        canonical=per_sample([one.canonical for one in outputs]),
        weight=per_sample([one.weight for one in outputs]),
        sample_color=per_sample([one.sample_color for one in outputs]),
    )


def render(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: Warp | None = None,
    precision: torch.dtype = torch.float32,
) -> VoxelOutput:
    """Colours and depths of rays: C = Σ w_i c_i + T_end · background.

    See docs/method.md#compositing.

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
        significant = _at_least(weight.detach(), settings.alpha_threshold)
        samples, canonical = samples[significant], canonical.index_select(0, significant)
        weight = weight.index_select(0, significant)
    with span("decoder"):
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision)
    with span("compositing"):
        seen = sum_by_ray(weight[:, None] * color, samples.ray, len(rays))
        with torch.no_grad():
            mass = sum_by_ray(weight, samples.ray, len(rays))
            depth = sum_by_ray(weight * samples.distance, samples.ray, len(rays))
    return VoxelOutput(
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

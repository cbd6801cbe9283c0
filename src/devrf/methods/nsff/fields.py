"""NSFF's two trunks, and the compositing of their densities in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from devrf.methods.nerf.networks import RadianceField, initialise
from devrf.methods.nerf.samples import last_of_ray
from devrf.methods.nsff.settings import NSFFSettings
from devrf.ops.compositing import composite, sum_by_ray

# No sample is more opaque than 1 − LEAST: its optical depth stays finite.
LEAST = 1e-6


@dataclass(frozen=True)
class Blend:
    """Weights of S samples of two fields along R rays.

    Attributes:
        dynamic: (S,) weights w_d of the dynamic field.
        static: (S,) weights w_s of the static field.
        transmittance: (R,) T_end: Σ (w_d + w_s) + T_end = 1 on each ray.
    """

    dynamic: Tensor
    static: Tensor
    transmittance: Tensor


def shared(dynamic: Tensor, static: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Optical depths of opacities v (1 − e^{−τ_d}) and (1 − v)(1 − e^{−τ_s}).

    Args:
        dynamic: (S,) τ_d of the dynamic field alone.
        static: (S,) τ_s of the static field alone.
        share: (S,) v in [0, 1], the share of the dynamic part.
    """
    moving = share * torch.expm1(-dynamic)
    still = (1 - share) * torch.expm1(-static)
    return -torch.log1p(moving.clamp(min=LEAST - 1)), -torch.log1p(still.clamp(min=LEAST - 1))


def blended(dynamic: Tensor, static: Tensor, ray: Tensor, rays: int) -> Blend:
    """Weights of two fields with optical depths τ_d and τ_s at the same samples.

    α = 1 − (1 − α_d)(1 − α_s), and each field has the part α_d / (α_d + α_s) of w = T α.

    Args:
        dynamic: (S,) τ_d, front to back within each ray.
        static: (S,) τ_s.
        ray: (S,) int64, ascending: the ray of each sample.
        rays: R.
    """
    weight, transmittance = composite(dynamic + static, ray, rays)
    opacity = -torch.expm1(-dynamic)
    other = -torch.expm1(-static)
    moving = weight * opacity / (opacity + other).clamp(min=1e-10)
    return Blend(moving, weight - moving, transmittance)


def closed(blend: Blend, share: Tensor, ray: Tensor) -> Blend:
    """The blend of rays whose last sample stands for all behind it: nothing is left to see.

    However dense both fields are there, (1 − α_d)(1 − α_s) = (1 − v) v is left of it.

    Args:
        blend: of S samples of R rays.
        share: (S,) v.
        ray: (S,) int64, ascending.
    """
    last = last_of_ray(ray).to(share)
    rest = last * blend.transmittance[ray]
    ends = sum_by_ray(last, ray, len(blend.transmittance))
    return Blend(
        blend.dynamic + rest * share,
        blend.static + rest * (1 - share),
        blend.transmittance * (1 - ends),
    )


# The flow's weights begin in ±SMALL, so that the first flows are next to zero.
SMALL = 1e-4
FORWARD = 0
BACKWARD = 1


@dataclass(frozen=True)
class StaticSamples:
    """The static field at S points.

    Attributes:
        raw: (S,) density before its activation.
        color: (S, 3) RGB.
        blend: (S,) v in [0, 1], the share of the dynamic part.
    """

    raw: Tensor
    color: Tensor
    blend: Tensor


@dataclass(frozen=True)
class DynamicSamples:
    """The dynamic field at S points, each at a time.

    Attributes:
        raw: (S,) density before its activation.
        color: (S, 3) RGB.
        flow: (S, 2, 3) displacement to the next frame and to the one before, in normalised space.
        occlusion: (S, 2) in [0, 1], the probability that the frame there does not show the point.
    """

    raw: Tensor
    color: Tensor
    flow: Tensor
    occlusion: Tensor


class HeadedField(RadianceField):
    """A radiance field that has one more linear head on its trunk."""

    def __init__(self, settings: NSFFSettings, *, inputs: int, further: int) -> None:
        """For points of length ``inputs``, with so many ``further`` numbers of each."""
        super().__init__(settings, inputs=inputs)
        self.further = nn.Linear(settings.width, further)
        initialise(self.further, settings.initialisation)

    def heads(self, points: Tensor, viewdirs: Tensor, ray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Raw density (S,), RGB (S, 3), and the further numbers of points (S, inputs)."""
        x = self.hidden(points)
        return self.density(x)[:, 0], self.rgb(x, viewdirs, ray), self.further(x)


class StaticField(HeadedField):
    """S(γ(x), γ(d)) → σ_s, c_s, v (docs/methods/nsff.md#model)."""

    def __init__(self, settings: NSFFSettings) -> None:
        super().__init__(settings, inputs=3, further=1)

    def at(self, points: Tensor, viewdirs: Tensor, ray: Tensor) -> StaticSamples:
        """The field at points (S, 3) of the rays ``ray`` (S,), whose directions are (R, 3)."""
        raw, color, share = self.heads(points, viewdirs, ray)
        return StaticSamples(raw, color, torch.sigmoid(share[:, 0]))


class DynamicField(HeadedField):
    """D(γ(x, 2t − 1), γ(d)) → σ_d, c_d, f⁺, f⁻, o⁺, o⁻ (docs/methods/nsff.md#model).

    Attributes:
        reach: the most that a point moves along an axis from a frame to the next.
    """

    def __init__(self, settings: NSFFSettings) -> None:
        super().__init__(settings, inputs=4, further=8)
        self.reach = 1.0
        with torch.no_grad():
            self.further.weight[:6].uniform_(-SMALL, SMALL)
            self.further.bias[:6].zero_()

    def at(self, points: Tensor, time: Tensor, viewdirs: Tensor, ray: Tensor) -> DynamicSamples:
        """The field at points (S, 3) and times (S,) in [0, 1]; else as the static one."""
        raw, color, motion = self.heads(with_time(points, time), viewdirs, ray)
        flow = self.reach * torch.tanh(motion[:, :6]).view(-1, 2, 3)
        return DynamicSamples(raw, color, flow, torch.sigmoid(motion[:, 6:]))


def with_time(points: Tensor, time: Tensor) -> Tensor:
    """(x, 2t − 1) (S, 4) of points (S, 3) and times (S,) in [0, 1]."""
    return torch.cat([points, 2 * time[:, None] - 1], dim=-1)


class TwoFields(nn.Module):
    """Both fields, and the joining of their densities.

    Attributes:
        static: the field that is the same at all times.
        dynamic: the field at a time.
    """

    def __init__(self, settings: NSFFSettings) -> None:
        """Build both networks."""
        super().__init__()
        self.static = StaticField(settings)
        self.dynamic = DynamicField(settings)
        self.additive = settings.blend == "additive"
        self._scale = settings.density_scale
        self._noise = settings.density_noise

    def noise(self, raw: Tensor) -> Tensor | float:
        """Noise for densities like ``raw`` (S,), to learn from them; 0 if none is configured."""
        return self._noise * torch.randn_like(raw) if self._noise else 0.0

    def optical_depth(self, raw: Tensor, length: Tensor | float, noise: Tensor | float) -> Tensor:
        """τ = σ δ (S,) with σ = scale · softplus(raw + noise); ``length`` in normalised units."""
        return nn.functional.softplus(raw + noise) * self._scale * length

    def blended(
        self, dynamic: Tensor, static: Tensor, v: Tensor, ray: Tensor, rays: int, *, unbounded: bool
    ) -> Blend:
        """Weights of optical depths (S,) of both fields.

        Args:
            dynamic: (S,) τ_d, front to back within each ray.
            static: (S,) τ_s.
            v: (S,) the share of the dynamic part; does not count where densities add.
            ray: (S,) int64, ascending.
            rays: R.
            unbounded: whether the last sample of each ray stands for all behind it.
        """
        if self.additive:
            return blended(dynamic, static, ray, rays)
        dynamic, static = shared(dynamic, static, v)
        blend = blended(dynamic, static, ray, rays)
        return closed(blend, v, ray) if unbounded else blend

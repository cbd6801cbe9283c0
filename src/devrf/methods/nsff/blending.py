"""Two densities composited in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

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
    return _scaled(dynamic, share), _scaled(static, 1 - share)


def _scaled(depth: Tensor, share: Tensor) -> Tensor:
    return -torch.log1p((share * torch.expm1(-depth)).clamp(min=LEAST - 1))


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
    opacity, other = -torch.expm1(-dynamic), -torch.expm1(-static)
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
    following = torch.cat([ray[1:], ray.new_full((1,), -1)])[: len(ray)]
    last = (ray != following).to(share)
    rest = last * blend.transmittance[ray]
    ends = sum_by_ray(last, ray, len(blend.transmittance))
    return Blend(
        blend.dynamic + rest * share,
        blend.static + rest * (1 - share),
        blend.transmittance * (1 - ends),
    )

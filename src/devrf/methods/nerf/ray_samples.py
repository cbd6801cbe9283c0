"""Samples along rays, one after another, and what they come to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.ops.compositing import color_and_depth, composite, sum_by_ray
from devrf.rendering.output import RenderOutput

# Opaque at any density that a softplus gives.
ENDLESS = 1e10


@dataclass(frozen=True)
class RaySamples:
    """S samples of R rays: ascending by ray, then front to back.

    Attributes:
        ray: (S,) int64, the ray of each sample.
        distance: (S,) along the ray, in units of its direction.
        length: (S,) of the stretch that each sample stands for, in units of the box.
        points: (S, 3) positions in the fields' space.
        rays: R.
    """

    ray: Tensor
    distance: Tensor
    length: Tensor
    points: Tensor
    rays: int

    @staticmethod
    def at(rays: Rays, ray: Tensor, distance: Tensor, stretch: Tensor | float) -> RaySamples:
        """Samples at ``distance`` (S,) along the rays ``ray`` (S,).

        Args:
            rays: R rays.
            ray: (S,) int64.
            distance: (S,) in units of the rays' directions.
            stretch: (S,) or a number, what each stands for, in these units.
        """
        unit = rays.directions.norm(dim=1).index_select(0, ray)
        return RaySamples(ray, distance, unit * stretch, rays.at(ray, distance), len(rays))

    def scaled(self, unit: float) -> RaySamples:
        """The same samples, their lengths in units of ``unit`` (of the fields' space)."""
        return replace(self, length=self.length / unit)

    def endless(self) -> RaySamples:
        """The same samples, the last of each ray standing for all that is behind it."""
        following = torch.cat([self.ray[1:], self.ray.new_full((1,), -1)])[: len(self.ray)]
        length = torch.where(self.ray != following, ENDLESS, self.length)
        return replace(self, length=length)


def volume_render(
    samples: RaySamples, density: Tensor, color: Tensor, background: Tensor
) -> RenderOutput:
    """C = Σ w_i c_i + T_end · background with α_i = 1 − exp(−σ_i δ_i).

    Args:
        samples: S samples of R rays.
        density: (S,) σ per unit of the samples' lengths.
        color: (S, 3) RGB.
        background: (3,) or (R, 3) RGB.

    Returns:
        ``extras`` has the ``weight`` (S,) and the ``ray`` (S,) of the samples.
    """
    ray, rays = samples.ray, samples.rays
    weight, transmittance = composite(density * samples.length, ray, rays)
    seen = sum_by_ray(weight[:, None] * color, ray, rays)
    with torch.no_grad():
        mass = sum_by_ray(weight, ray, rays)
        reached = sum_by_ray(weight * samples.distance, ray, rays)
    image, depth = color_and_depth(seen, reached, mass, transmittance, background)
    return RenderOutput(
        color=image,
        depth=depth,
        transmittance=transmittance,
        extras={"weight": weight, "ray": ray},
    )

"""Renders without gradients, front to back: what has been hidden is never looked at.

Gives what :func:`devrf.methods.devrf.volume_rendering.render` gives, in slabs: some segments of all
rays at a time, of those rays alone through which something can still be seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.ops.compositing import color_and_depth, firsts, sum_by_ray, transmittances
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, RenderedImage
from devrf.rendering.sampling import STOP, RenderSettings, Segments, segments_near

# Segments of a ray in one slab: fewer are left off sooner, more are fewer operations.
SLAB = 8


class VoxelField(Protocol):
    """A voxel radiance field, as it is rendered without its stages."""

    @property
    def box(self) -> Box:
        """Where it lives."""

    def step_length(self, step: float) -> float:
        """Length of ``step`` voxels along a ray, in units of the ray's direction."""

    def step_in_base_voxels(self, step: float) -> float:
        """δ, the length that opacities are taken over."""

    def optical_depth(self, points: Tensor, delta: float) -> Tensor:
        """τ (M,) at ``points`` (M, 3), for steps of δ base voxels."""

    def rgb(
        self,
        points: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        precision: torch.dtype = torch.float32,
        residual: Tensor | None = None,
    ) -> Tensor:
        """RGB (S, 3) at ``points`` (S, 3) on rays ``ray`` (S,) with ``viewdirs`` (R, 3)."""


@torch.no_grad()
def picture(
    rays: Rays,
    field: VoxelField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: Callable[[Tensor], Tensor] | None = None,
    color_change: ColorChange | None = None,
) -> RenderedImage:
    """What rays see.

    Args:
        rays: R rays in the field's space.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind everything, if the space does not hold infinity.
        warp: x → q = x + Δ_b(x, t), points (M, 3) to canonical space; None is the identity.
        color_change: q → A_t(q), added to the colours' logits; None: nothing is.
    """
    delta, threshold = field.step_in_base_voxels(settings.step), settings.alpha_threshold
    limits = {"near": settings.near, "far": settings.far}
    step = field.step_length(settings.step)
    segments = segments_near(rays, field.box, occupancy, step=step, **limits)
    left = torch.ones_like(rays.origins[:, 0])
    # Of each ray: Σ w_i c_i, Σ w_i z_i and Σ w_i.
    sums = left.new_zeros((len(rays), 5))
    for slab in _slabs(segments, left):
        samples = slab.samples(rays, occupancy)
        points = samples.points if warp is None else warp(samples.points)
        tau = field.optical_depth(points, delta)
        alpha = -torch.expm1(-tau)
        opaque = (alpha >= threshold).nonzero()[:, 0]
        ray, tau = samples.ray.index_select(0, opaque), tau.index_select(0, opaque)
        reached = left.index_select(0, ray) * transmittances(tau, ray, len(rays))
        tau = torch.where(reached >= STOP, tau, 0.0)
        weight = reached * -torch.expm1(-tau)
        left *= torch.exp(-sum_by_ray(tau, ray, len(rays)))
        significant = (weight >= threshold).nonzero()[:, 0]
        kept = opaque.index_select(0, significant)
        weight, ray = weight.index_select(0, significant), ray.index_select(0, significant)
        points = points.t().index_select(1, kept).t()
        residual = None if color_change is None else color_change(points)
        color = field.rgb(points, rays.viewdirs, ray, residual=residual)
        distance = samples.distance.index_select(0, kept)
        seen = torch.cat([color, torch.stack([distance, torch.ones_like(distance)], 1)], 1)
        sums.index_add_(0, ray, weight[:, None] * seen)
    end_color = behind(rays, field, background)
    image, depth = color_and_depth(sums[:, :3], sums[:, 3], sums[:, 4], left, end_color)
    return RenderedImage(image, depth, 1 - left)


def behind(
    rays: Rays, field: VoxelField, background: Tensor, precision: torch.dtype = torch.float32
) -> Tensor:
    """What rays end in: the ``background``, or the field's colours (R, 3) if it holds infinity."""
    ends = rays.ends()
    if ends is None:
        return background
    return field.rgb(ends, rays.viewdirs, torch.arange(len(rays), device=ends.device), precision)


def _slabs(segments: Segments, left: Tensor) -> Iterator[Segments]:
    """The next segments of each ray, while ``left`` (R,), which changes, is what passes it."""
    edges = firsts(segments.ray, len(left))
    following, last = edges[:-1], edges[1:]
    within = torch.arange(SLAB, device=left.device)
    while True:
        alive = ((following < last) & (left >= STOP)).nonzero()[:, 0]
        if len(alive) == 0:
            return
        index = following.index_select(0, alive)[:, None] + within
        yield segments[index[index < last.index_select(0, alive)[:, None]]]
        following = following + SLAB

"""Renders on lists of fixed length, so that nothing waits for the device.

Gives what :func:`devrf.methods.devrf.volume_rendering.render` gives. CUDA graphs need it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.pixel_rays import steps_in_box
from devrf.ops.search import PackedSamples, Thresholds, find_samples, select_listed
from devrf.ops.trilinear import kept_gradient
from devrf.ops.warped_depth import warped_depth
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorChange, RenderedImage, VoxelOutput
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.rendering.sampling import STOP, RenderSettings, Samples, most_steps
from devrf.system.profiling import span


class VoxelField(Protocol):
    """A voxel radiance field, as it is rendered without its stages."""

    @property
    def box(self) -> Box:
        """Where it lives."""

    @property
    def raw_density(self) -> Tensor:
        """Raw densities v (X, Y, Z, 1), before the softplus."""

    @property
    def shift(self) -> float:
        """What is added to a raw density before the softplus."""

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


def render_static(
    rays: Rays,
    field: VoxelField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    slices: Sequence[Tensor],
    slice_weight: float,
    capacity: SampleCapacity,
    precision: torch.dtype = torch.float32,
    color_change: ColorChange | None = None,
) -> VoxelOutput:
    """What ``render`` gives for the same arguments, in lists of ``capacity.significant`` places.

    Gradients of grids that have one already (``grad``) are added to it in place.
    ``samples.present`` tells samples from padding.

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind everything.
        slices: displacements (X', Y', Z', 3) over the field's own box that map the rays' points
            into canonical space: one frame's, two frames' that are blended, or none.
        slice_weight: of the second in the blend.
        capacity: how long the lists are; the lengths that were needed are noted in it.
        precision: what the colour network works in.
        color_change: q → A_t(q), added to the colours' logits; None: nothing is.
    """
    density = field.raw_density
    with span("sampling"):
        scene = rays, field, occupancy, settings, slices, slice_weight
        packed = search(*scene, capacity=capacity.visible)
    with span("density"):
        canonical, tau = warped_depth(
            packed.points,
            density,
            slices,
            slice_weight,
            box=field.box,
            shift=field.shift,
            delta=field.step_in_base_voxels(settings.step),
            density_gradient=kept_gradient(density),
            slice_gradients=[kept_gradient(frame) for frame in slices],
        )
    with span("compositing"):
        weight, transmittance = composite_segments(tau, packed.first)
    with span("sampling"):
        chosen = select_listed(packed, canonical, weight, capacity.significant)
        capacity.note(packed.total, chosen.total)
        samples = Samples(
            chosen.ray, chosen.distance, chosen.points, len(rays), present=chosen.present
        )
        canonical, weight = chosen.canonical, chosen.weight
    with span("decoder"):
        residual = None if color_change is None else color_change(canonical)
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision, residual)
    with span("compositing"):
        listed = weight, color, samples.distance, chosen.first
        image, depth = composite_colors(*listed, transmittance, background)
    return VoxelOutput(
        color=image,
        depth=depth,
        transmittance=transmittance,
        samples=samples,
        canonical=canonical,
        weight=weight,
        sample_color=color,
        residual=residual,
        first=chosen.first,
    )


class ListRenderer:
    """Renders a canonical field, moved or at rest; its lists grow to the length pictures need.

    ``half``: the colour network works in half precision (CUDA only).
    """

    def __init__(self, field: VoxelField, settings: RenderSettings, *, half: bool = False) -> None:
        self.field, self.settings, self.half = field, settings, half
        # By the bits of the number of rays: a picture's last chunk has fewer, and shorter lists.
        self._capacities: dict[int, SampleCapacity] = {}

    @torch.no_grad()
    def picture(
        self,
        rays: Rays,
        occupancy: Occupancy,
        displacement: Tensor | None,
        background: Tensor,
        color_change: ColorChange | None = None,
    ) -> RenderedImage:
        """What rays see. The host waits once, at the end, to know that the lists were long enough.

        Args:
            rays: R rays in the field's space.
            occupancy: where something is at their time.
            displacement: (X, Y, Z, 3) over the field's box, their time's points → canonical
                space; None at rest.
            background: (3,) or (R, 3) RGB.
            color_change: q → A_t(q), added to the colours' logits; None: nothing is.
        """
        if not len(rays):  # padding would repeat one
            nothing = rays.origins[:, 0]
            return RenderedImage(rays.origins, nothing, nothing)
        size, device = len(rays).bit_length(), rays.origins.device
        if (capacity := self._capacities.pop(size, None)) is None:
            capacity = SampleCapacity(0, device)
        precision = torch.float16 if self.half and device.type != "cpu" else torch.float32
        scene = rays, self.field, occupancy, self.settings, background
        moved = (() if displacement is None else (displacement,)), 0.0
        while True:
            seen = render_static(*scene, *moved, capacity, precision, color_change)
            if capacity.suffices():
                self._capacities[size] = capacity  # begun anew where memory ran out before
                return RenderedImage(seen.color, seen.depth, opacity=1 - seen.transmittance)


def search(
    rays: Rays,
    field: VoxelField,
    occupancy: Occupancy,
    settings: RenderSettings,
    slices: Sequence[Tensor],
    slice_weight: float = 0.0,
    *,
    capacity: int,
) -> PackedSamples:
    """What of R rays can be seen, as :func:`~devrf.ops.search.find_samples` gives it.

    Arguments as for :func:`render_static`. The lists have ``capacity`` places.
    """
    step = field.step_length(settings.step)
    limits = {"step": step, "near": settings.near, "far": settings.far}
    entry, count = steps_in_box(rays.origins, rays.directions, box=field.box, **limits)
    threshold = settings.alpha_threshold
    return find_samples(
        rays.origins,
        rays.directions,
        entry,
        count,
        occupancy.mask,
        field.raw_density,
        slices,
        slice_weight,
        step=step,
        longest=most_steps(field.box, **limits),
        capacity=capacity,
        mask_box=occupancy.box,
        box=field.box,
        shift=field.shift,
        delta=field.step_in_base_voxels(settings.step),
        thresholds=Thresholds(threshold, STOP, threshold),
    )

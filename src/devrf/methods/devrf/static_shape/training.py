"""Renders for training on lists of fixed length, so that nothing waits for the device.

Gives what :func:`devrf.methods.devrf.volume_rendering.render` gives. CUDA graphs need it, and
Triton's kernels make it fast; their plain PyTorch twins give the same, more slowly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.appearance import ColorResidual
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.static_shape.sample_search import search
from devrf.methods.devrf.volume_rendering import VoxelOutput
from devrf.ops.compositing import composite_colors, composite_segments
from devrf.ops.search import select_listed
from devrf.ops.trilinear import kept_gradient
from devrf.ops.warped_depth import warped_depth
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.rendering.sampling import Samples
from devrf.system.profiling import span


def render_static(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    warp: GridWarp | None,
    capacity: SampleCapacity,
    precision: torch.dtype = torch.float32,
    appearance: ColorResidual | None = None,
) -> VoxelOutput:
    """What ``render`` gives for the same arguments, in lists of ``capacity.significant`` places.

    Gradients of grids that have one already (``grad``) are added to it in place.

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind everything.
        warp: maps the rays' points into canonical space, over the field's own box; None leaves
            them.
        capacity: how long the lists are; the lengths that were needed are noted in it.
        precision: what the colour network works in.
        appearance: q → A_t(q), added to the colours' logits; None: nothing is.

    Returns:
        What the rays see; ``samples.present`` tells samples from padding.
    """
    warp = warp or GridWarp((), field.box)
    density = field.density.values
    with span("sampling"):
        found = search(
            rays, field, occupancy, settings, warp, capacity=capacity.visible, wait=False
        )
    with span("density"):
        canonical, tau = warped_depth(
            found.points,
            density,
            warp.slices,
            warp.weight,
            box=field.box,
            shift=field.shift,
            delta=field.step_in_base_voxels(settings.step),
            density_gradient=kept_gradient(density),
            slice_gradients=[kept_gradient(frame) for frame in warp.slices],
        )
    with span("compositing"):
        weight, transmittance = composite_segments(tau, found.first)
    with span("sampling"):
        chosen = select_listed(found, canonical, weight, capacity.significant)
        capacity.note(found.total, chosen.total)
        samples = Samples(
            chosen.ray, chosen.distance, chosen.points, len(rays), present=chosen.present
        )
        canonical, weight = chosen.canonical, chosen.weight
    with span("decoder"):
        residual = None if appearance is None else appearance(canonical)
        color = field.rgb(canonical, rays.viewdirs, samples.ray, precision, residual, chosen.first)
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

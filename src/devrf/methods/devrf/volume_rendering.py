"""Volume rendering of a canonical field, at rest or warped: batches and pictures alike.

The samples of each ray, docs/method.md#rays, composited: docs/method.md#compositing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.kernels.compositing import composite_colors
from devrf.kernels.march import march
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import GridWarp
from devrf.ops.march import MarchInputs, MarchRange
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.output import ColorResidual, VoxelOutput
from devrf.rendering.sampling import RenderSettings
from devrf.system.profiling import span


def render(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    background: Tensor,
    backward_warp: GridWarp | None = None,
    color_residual: ColorResidual | None = None,
) -> VoxelOutput:
    """Colours Ĉ = Σ w_i c_i + T_end · C_background and depths Σ w_i z_i / Σ w_i of rays.

    Args:
        rays: R rays.
        field: the canonical field.
        occupancy: an upper bound, in the space of the rays.
        settings: step length and thresholds.
        background: (3,) or (R, 3) RGB behind all; the field's own if the space holds infinity.
        backward_warp: x → q = x + Δ_b(x, t); None is the identity.
        color_residual: q → A_t(q), added to the colours' logits; None: nothing is.

    Returns:
        The render; differentiable in the parameters of field, backward warp and colour residual.
    """
    with span("sampling"):
        samples = march(rays, march_inputs(field, occupancy, settings, backward_warp))
    with span("decoder"):
        residual = None if color_residual is None else color_residual(samples.canonical)
        color = field.rgb(samples.canonical, rays.viewdirs, samples.ray, residual)
        ends = rays.ends()
        if ends is not None:
            every = torch.arange(len(rays), device=ends.device)
            background = field.rgb(ends, rays.viewdirs, every)
    with span("compositing"):
        image = composite_colors(samples, color, background)
    return VoxelOutput(
        color=image,
        depth=samples.depth,
        transmittance=samples.transmittance,
        samples=samples,
        sample_color=color,
        background=background,
        color_residual=residual,
    )


def march_inputs(
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    backward_warp: GridWarp | None = None,
) -> MarchInputs:
    """A field, its occupancy and its backward warp, as the march reads them."""
    warp = backward_warp or GridWarp(None, field.box)
    displacement = warp.displacement
    limits = MarchRange(
        box=field.box,
        distances=occupancy.distances,
        step=field.step_length(settings.step),
        near=settings.near,
        far=settings.far,
    )
    return MarchInputs(
        range=limits,
        density=field.density.values,
        shift=field.shift,
        delta=field.step_in_base_voxels(settings.step),
        threshold=settings.alpha_threshold,
        displacement=displacement,
        displacement_box=None if displacement is None else warp.box,
        zero_outside_box=warp.zero_outside_box,
    )


@torch.no_grad()
def deformed_occupancy(
    field: CanonicalField, occupancy: Occupancy, settings: RenderSettings, backward_warp: GridWarp
) -> Occupancy:
    """The occupancy at a time: the points of the density's grid that move to opaque space.

    Space is opaque if its opacity is that of a visible sample, there or at the nearest point of the
    densities; a thin thing may lie between the positions that points come from.
    It is grown by one, for the space between the moved points.

    Args:
        field: the canonical field.
        occupancy: of the scene at rest.
        settings: of the sampling of rays.
        backward_warp: x → x + Δ_b(x, t).
    """
    box, shape, densities = field.box, field.density.shape, field.density.values
    moved = backward_warp.of_grid(box, shape, densities.device)
    arrived = occupancy.at(moved)
    canonical = moved[arrived]
    x, y, z = box.to_grid(box.nearest(canonical), shape).round().long().unbind(1)
    raw = torch.maximum(field.density(canonical, box), densities[x, y, z])
    opaque = arrived.clone()
    opaque[arrived] = field.alpha(raw, settings.step)[:, 0] >= settings.alpha_threshold
    return Occupancy(dilate(opaque.view(shape), 1), box)


@torch.no_grad()
def possible_occupancy(occupancy: Occupancy, backward_warp: GridWarp) -> Occupancy:
    """The occupancy while a frame is learned, of the grid of that at rest.

    It is wider than :func:`deformed_occupancy`, since the displacements go on changing: all that
    may be occupied at rest, grown by one point.
    """
    x, y, z = occupancy.mask.shape
    arrived = occupancy.at(backward_warp.of_grid(occupancy.box, (x, y, z), occupancy.mask.device))
    return Occupancy(dilate(arrived.view(x, y, z), 1), occupancy.box)

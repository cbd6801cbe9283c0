"""Finds the samples that can be seen, for a canonical field under a warp."""

from __future__ import annotations

from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.grid_warp import GridWarp
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.volume_rendering import STOP
from devrf.ops.pixel_rays import steps_in_box
from devrf.ops.search import PackedSamples, Thresholds, find_samples
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import most_steps


def search(
    rays: Rays,
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    warp: GridWarp,
    *,
    capacity: int,
    wait: bool,
) -> PackedSamples:
    """What of R rays can be seen, as :func:`~devrf.ops.search.find_samples` gives it.

    Args:
        rays: R rays in the field's space.
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        warp: the rays' points → canonical space, over the field's own box.
        capacity: the length of the lists.
        wait: count the samples of the longest ray, which waits for the device; False uses an
            upper bound.
    """
    step = field.step_length(settings.step)
    limits = {"step": step, "near": settings.near, "far": settings.far}
    entry, count = steps_in_box(rays.origins, rays.directions, box=field.box, **limits)
    if wait:
        longest = int(count.amax()) if len(rays) else 0
    else:
        longest = most_steps(field.box, **limits)
    threshold = settings.alpha_threshold
    return find_samples(
        rays.origins,
        rays.directions,
        entry,
        count,
        occupancy.mask,
        field.density.values,
        warp.slices,
        warp.weight,
        step=step,
        longest=longest,
        capacity=capacity,
        mask_box=occupancy.box,
        box=field.box,
        shift=field.shift,
        delta=field.step_in_base_voxels(settings.step),
        thresholds=Thresholds(threshold, STOP, threshold),
    )

"""The search for samples that can be seen, put to a canonical field and its settings."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from devrf.geometry.rays import Rays
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.volume_rendering import STOP
from devrf.ops.search import PackedSamples, Thresholds, find_samples
from devrf.rendering.occupancy import Occupancy


def search(
    rays: Rays,
    begins: tuple[Tensor, Tensor],
    field: CanonicalField,
    occupancy: Occupancy,
    settings: RenderSettings,
    slices: Sequence[Tensor],
    weight: float = 0.0,
    *,
    longest: int,
    capacity: int,
) -> PackedSamples:
    """What of R rays can be seen, as :func:`~devrf.ops.search.find_samples` gives it.

    Args:
        rays: R rays in the field's space.
        begins: distance (R,) of each ray's first sample, and how many (R,) it has
            (:func:`~devrf.rendering.sampling.steps_through`).
        field: the canonical field.
        occupancy: where something may be, in the space of the rays.
        settings: step length and thresholds.
        slices: displacements over the field's box: none, one frame's, or two frames'.
        weight: share of the second of two frames.
        longest: no ray has more samples.
        capacity: the length of the lists.
    """
    entry, count = begins
    threshold = settings.alpha_threshold
    return find_samples(
        rays.origins,
        rays.directions,
        entry,
        count,
        occupancy.mask,
        field.density.values,
        slices,
        weight,
        step=field.step_length(settings.step),
        longest=longest,
        capacity=capacity,
        mask_box=occupancy.box,
        box=field.box,
        shift=field.shift,
        delta=field.step_in_base_voxels(settings.step),
        thresholds=Thresholds(threshold, STOP, threshold),
    )

"""Drawn pixels become a batch: their rays, and what the images show there."""

from __future__ import annotations

from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.ops.pixel_rays import gather_pixels
from devrf.scenes.scene import Views


def gather_batch(
    views: Views,
    image: Tensor,
    flat: Tensor,
    background: Tensor,
    space: Space = WORLD,
) -> RayBatch:
    """The batch of given pixels.

    Args:
        views: images and cameras, on the device of the indices.
        image: (R,) int64, which image.
        flat: (R,) int64, row-major pixel number within it.
        background: (3,) or (R, 3) RGB in [0, 1] that colours are composited on.
        space: the space that the fields live in.

    Returns:
        Rays in the fields' space with the truth at their pixels.
    """
    assert views.frames is not None, "views of a scene know their frames"
    cameras, flow = views.cameras, views.flow
    found = gather_pixels(
        image,
        flat,
        views.pixels,
        cameras.camera_to_world,
        cameras.focal,
        cameras.center,
        background,
        views.times,
        views.frames,
        None if flow is None else (flow.vectors, flow.valid),
    )
    return RayBatch(
        rays=space.rays(Rays(found.origins, found.directions, found.directions)),
        color=found.color,
        alpha=found.alpha,
        background=background,
        time=found.time,
        frame=found.frame,
        image=image,
        pixel=found.pixel,
        flow=found.flow,
        flow_valid=found.flow_valid,
    )

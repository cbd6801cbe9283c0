"""Drawn pixels become a batch of rays, with the truth there."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devrf.data.batch import RayBatch, pixel_positions
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.kernels.pixels import look_up
from devrf.kernels.runtime import is_supported
from devrf.scenes.scene import Views


def gather_batch(
    views: Views, image: Tensor, flat: Tensor, background: Tensor, space: Space = WORLD
) -> RayBatch:
    """The rays of given pixels in the fields' space, with the truth there.

    Args:
        views: images and cameras, on the device of the indices.
        image: (R,) int64, the image of each ray.
        flat: (R,) int64, row-major pixel number within it.
        background: (3,) or (R, 3) RGB in [0, 1] that colours are composited on.
        space: the space that the fields live in.
    """
    pixel, rays, color, alpha, time, frame, flow, valid = _looked_up(views, image, flat, background)
    return RayBatch(
        rays=space.rays(rays),
        color=color,
        alpha=alpha if views.has_alpha else None,
        background=background,
        time=time,
        frame=frame,
        image=image,
        pixel=pixel,
        flow=None if views.flow is None else flow,
        flow_valid=None if views.flow is None else valid,
    )


def _looked_up(views: Views, image: Tensor, flat: Tensor, background: Tensor) -> tuple[Any, ...]:
    """Centres, rays, colours, alphas, times, frames, flow and where it is valid, of pixels."""
    assert views.frames is not None, "views of a scene know their frames"
    flow = None if views.flow is None else (views.flow.vectors, views.flow.valid)
    read = [views.pixels, views.cameras.camera_to_world, views.cameras.focal, *(flow or ())]
    compact = all(each.is_contiguous() for each in read)
    if compact and views.pixels[..., 0].numel() < 2**31 and is_supported(views.cameras.focal):
        of_images = views.times, views.frames
        looked_up = look_up(views.pixels, views.cameras, of_images, flow, image, flat, background)
        pixel, origins, directions, *rest = looked_up
        return pixel, Rays(origins, directions, directions), *rest
    index = image * (views.height * views.width) + flat
    pixel = pixel_positions(flat, views.width)
    rgba = views.pixels.flatten(0, 2).index_select(0, index).float() / 255
    color, alpha = rgba[:, :3], rgba[:, 3:].flatten()
    if views.has_alpha:
        color = background + alpha[:, None] * (color - background)
    vectors = valid = None
    if flow is not None:
        valid = flow[1].flatten()[index]
        # Flow that is not valid may be NaN.
        vectors = torch.where(valid[:, None], flow[0].flatten(0, 2)[index], 0.0)
    rays = views.cameras.rays(image, pixel)
    return pixel, rays, color, alpha, views.times[image], views.frames[image], vectors, valid

"""Drawn pixels become a batch of rays, with the truth there."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from devrf.data.batch import RayBatch
from devrf.geometry.cameras import pixel_positions
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space
from devrf.kernels.pixels import look_up
from devrf.kernels.runtime import is_supported
from devrf.scenes.scene import Views


def gather_batch(
    views: Views,
    image: Tensor,
    flat: Tensor,
    background: Tensor,
    space: Space = WORLD,
    per_pixel: int = 1,
) -> RayBatch:
    """The rays of P given pixels in the fields' space, with the truth there.

    Args:
        views: images and cameras, on the device of the indices.
        image: (P,) int64, the image of each pixel.
        flat: (P,) int64, its row-major number within it.
        background: (3,) or (P, 3) RGB in [0, 1] that colours are composited on.
        space: the space that the fields live in.
        per_pixel: the rays of each pixel (:func:`~devrf.geometry.cameras.pixel_positions`), which
            follow one another.
    """
    if per_pixel > 1:
        image, flat = image.repeat_interleave(per_pixel), flat.repeat_interleave(per_pixel)
        if background.ndim == 2:
            background = background.repeat_interleave(per_pixel, dim=0)
    pixel, rays, color, alpha, time, frame, flow, valid = _looked_up(
        views, image, flat, background, per_pixel
    )
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
        per_pixel=per_pixel,
    )


def _looked_up(
    views: Views, image: Tensor, flat: Tensor, background: Tensor, per_pixel: int
) -> tuple[Any, ...]:
    """Positions, rays, colours, alphas, times, frames, flow and where it is valid, of R rays.

    Those of a pixel follow one another in ``image`` and ``flat`` (R,).
    """
    assert views.frames is not None, "views of a scene know their frames"
    flow = None if views.flow is None else (views.flow.vectors, views.flow.valid)
    read = [views.pixels, views.cameras.camera_to_world, views.cameras.focal, *(flow or ())]
    compact = all(each.is_contiguous() for each in read)
    if compact and views.pixels[..., 0].numel() < 2**31 and is_supported(views.cameras.focal):
        of_images = views.times, views.frames
        looked_up = look_up(
            views.pixels, views.cameras, of_images, flow, image, flat, background, per_pixel
        )
        pixel, origins, directions, *rest = looked_up
        return pixel, Rays(origins, directions, directions), *rest
    index = image * (views.height * views.width) + flat
    pixel = pixel_positions(flat[::per_pixel], views.width, per_pixel)
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

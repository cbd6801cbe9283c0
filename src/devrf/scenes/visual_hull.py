"""Where matter can be at all: inside the silhouettes of every view that could see it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.scenes.scene import Views


def visual_hull(
    views: Views, box: Box, shape: tuple[int, int, int], device: torch.device | None = None
) -> Tensor:
    """The visual hull of one state of the scene, on a grid.

    A grid point is outside when any view that has it in the picture sees no alpha mask within half
    a grid cell of it; so the hull holds everything, and more where no view looks, or where its
    pixels are not valid.

    Args:
        views: images with alpha masks that all show the same state.
        box: where the grid is, world units; its corners sit on the box's corners.
        shape: grid points along x, y, z.
        device: where to work, one image after another; None: where the views are.

    Returns:
        (X, Y, Z) bool on that device.
    """
    cameras = views.cameras if device is None else views.cameras.to(device)
    points = box.grid_points(shape, cameras.focal).reshape(-1, 3)
    cell = max(edge / (n - 1) for edge, n in zip(box.size, shape, strict=True))
    held = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for k in range(len(views)):
        left = held.nonzero()[:, 0]
        pixel, depth = cameras.project_into(k, points[left])
        reach = _reach(views, k, cell, box)
        matte = views.pixels[k, :, :, 3][None].float()
        if views.valid_mask is not None:
            matte = matte.masked_fill(~views.valid_mask[k], 255.0)
        matte = matte.to(points.device)
        grown = torch.nn.functional.max_pool2d(matte, 2 * reach + 1, 1, reach)[0]
        x, y = pixel.floor().long().unbind(-1)
        seen = (depth > 0) & (x >= 0) & (x < views.width) & (y >= 0) & (y < views.height)
        row = torch.where(seen, y * views.width + x, 0)
        held[left[seen & (grown.view(-1)[row] == 0)]] = False
    return held.view(shape)


def _reach(views: Views, k: int, cell: float, box: Box) -> int:
    """Pixels that half a cell's diagonal covers where the box is nearest to the camera."""
    position = views.cameras.positions[k]
    nearest = float((position - box.nearest(position)).norm())
    focal = float(views.cameras.focal[k].max())
    pixels = math.sqrt(3) / 2 * cell * focal / max(nearest, cell)
    return max(1, min(math.ceil(pixels), max(views.width, views.height)))

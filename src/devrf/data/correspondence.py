"""Which image shows the same view one frame earlier."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Views


def previous_images(views: Views) -> Tensor:
    """For each of N images the one that its backward flow leads to.

    That is the image before it in the same view; a moving camera's images (each its own view)
    follow one another as one sequence. An image without a predecessor is its own.

    Returns:
        (N,) int64 on the device of the views.
    """
    previous = torch.arange(len(views), device=views.times.device)
    for image, earlier in frame_pairs(views):
        previous[image] = earlier
    return previous

"""Which image shows the same view one frame earlier."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.clock import FrameClock
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Views


def previous_images(views: Views, clock: FrameClock) -> Tensor:
    """For each of N images the one that its backward flow leads to.

    That is the image of the same view one frame earlier; for a moving camera (an image a view)
    the only image one frame earlier, if there is just one. An image without a predecessor is
    its own.

    Returns:
        (N,) int64 on the device of the views.
    """
    previous = torch.arange(len(views), device=views.times.device)
    for image, earlier in frame_pairs(views):
        previous[image] = earlier
    return previous

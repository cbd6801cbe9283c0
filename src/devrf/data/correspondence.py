"""Which image shows the same view one frame earlier."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.clock import FrameClock
from devrf.scenes.scene import Views


def previous_images(views: Views, clock: FrameClock) -> Tensor:
    """For each of N images the one that its backward flow leads to.

    That is the image of the same view one frame earlier; for a moving camera (an image a view)
    the only image one frame earlier, if there is just one. An image without a predecessor is
    its own.

    Returns:
        (N,) int64 on the device of the views.
    """
    frame = clock.frames_of(views.times)
    own = torch.arange(len(views), device=frame.device)
    earlier = frame[None, :] == frame[:, None] - 1
    same_view = earlier & (views.view[None, :] == views.view[:, None])
    alone = earlier & (earlier.sum(dim=1, keepdim=True) == 1)
    match = torch.where(same_view.any(dim=1, keepdim=True), same_view, alone)
    return torch.where(match.any(dim=1), match.int().argmax(dim=1), own)

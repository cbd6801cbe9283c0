"""A dense grid at another resolution."""

from __future__ import annotations

import torch
from torch import Tensor


def resample(values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """A grid (X, Y, Z, C) at another resolution ``shape``, trilinear, corners kept in place."""
    if tuple(values.shape[:3]) == tuple(shape):
        return values.detach().clone()
    channels_first = values.permute(3, 0, 1, 2)[None]
    resized = torch.nn.functional.interpolate(
        channels_first, size=shape, mode="trilinear", align_corners=True
    )
    # Not contiguous(): of a single channel it keeps a stray stride, and look-ups become slow.
    return resized[0].permute(1, 2, 3, 0).clone(memory_format=torch.contiguous_format)

"""Sinusoidal encodings of positions, directions and times, and windows over their octaves."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class SinusoidalEncoding(nn.Module):
    """γ(x) = x ⊕ sin(2^k x) ⊕ cos(2^k x) for k = 0 … bands − 1 (docs/methods/dnerf.md#encoding).

    Attributes:
        size: length of the encoding of a vector.
    """

    octaves: Tensor

    def __init__(self, dimensions: int, bands: int, *, identity: bool = True) -> None:
        """Build the encoding.

        Args:
            dimensions: length of the vectors.
            bands: octaves; 0 gives the vector alone.
            identity: whether the vector itself is a part of its encoding.
        """
        super().__init__()
        self.register_buffer("octaves", 2.0 ** torch.arange(bands), persistent=False)
        self._identity = identity
        self.size = dimensions * (identity + 2 * bands)

    def forward(self, values: Tensor, window: Tensor | None = None) -> Tensor:
        """Encodings (..., size) of ``values`` (..., dimensions).

        Args:
            values: the vectors.
            window: (bands,) factors of the octaves; the vector itself has none. None: all 1.
        """
        angles = (values[..., None, :] * self.octaves[:, None]).flatten(-2)
        waves = [angles.sin(), angles.cos()]
        if window is not None:
            factor = window.repeat_interleave(values.shape[-1])
            waves = [wave * factor for wave in waves]
        return torch.cat([values, *waves] if self._identity else waves, dim=-1)


def octave_window(opened: Tensor, bands: int) -> Tensor:
    """w_k(α) = ½ (1 − cos(π · clamp(α − k, 0, 1))) for k = 0 … bands − 1: coarse octaves first.

    See docs/methods/nerfies.md#window.

    Args:
        opened: () α: how many octaves are open; 0 shuts all, ``bands`` opens all.
        bands: octaves.

    Returns:
        (bands,) factors in [0, 1].
    """
    octave = torch.arange(bands, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octave).clamp(0, 1))) / 2

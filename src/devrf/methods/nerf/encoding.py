"""Sinusoidal encodings of positions, directions and times."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class SinusoidalEncoding(nn.Module):
    """γ(x) = x ⊕ sin(2^k x) ⊕ cos(2^k x) for k = 0 … bands − 1 (docs/methods/dnerf.md#encoding).

    Attributes:
        size: length of the encoding of a vector.
    """

    octaves: Tensor

    def __init__(self, dimensions: int, bands: int) -> None:
        """Build the encoding.

        Args:
            dimensions: length of the vectors.
            bands: octaves; 0 gives the vector alone.
        """
        super().__init__()
        self.register_buffer("octaves", 2.0 ** torch.arange(bands), persistent=False)
        self.size = dimensions * (1 + 2 * bands)

    def forward(self, values: Tensor) -> Tensor:
        """Encodings (..., size) of ``values`` (..., dimensions)."""
        angles = (values[..., None, :] * self.octaves[:, None]).flatten(-2)
        return torch.cat([values, angles.sin(), angles.cos()], dim=-1)

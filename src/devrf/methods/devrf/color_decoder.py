"""Colour decoders: interpolated features and a viewing direction → RGB."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.ops.color_network import ColorNetwork, decode


class SigmoidColor(nn.Module):
    """Three channels are the colour itself, before a sigmoid: no network, no view dependence."""

    def forward(
        self,
        features: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        precision: torch.dtype = torch.float32,
        residual: Tensor | None = None,
    ) -> Tensor:
        """RGB (S, 3) in [0, 1] of ``features`` (S, 3), whatever the direction."""
        return torch.sigmoid(features if residual is None else features + residual)


class ColorDecoder(nn.Module):
    """c = sigmoid(MLP(f, d, sin(2^k d), cos(2^k d))) (docs/method.md#colour).

    Attributes:
        learns_directions: whether gradients reach the direction part of the first layer.
    """

    octaves: Tensor

    def __init__(self, channels: int, width: int, frequencies: int = 4) -> None:
        """Build the network.

        Args:
            channels: length of the feature vectors.
            width: units of each of the two hidden layers.
            frequencies: octaves k = 0 … frequencies − 1 of the direction; 0 gives it alone.
        """
        super().__init__()
        self.register_buffer("octaves", 2.0 ** torch.arange(frequencies), persistent=False)
        self.from_feature = nn.Linear(channels, width)
        self.from_direction = nn.Linear(3 + 6 * frequencies, width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.output = nn.Linear(width, 3)
        nn.init.zeros_(self.output.bias)
        self.learns_directions = True

    def forget_directions(self) -> None:
        """Make colours the same from everywhere, until directions are learned."""
        nn.init.zeros_(self.from_direction.weight)

    @property
    def network(self) -> ColorNetwork:
        """The weights, as :func:`~devrf.ops.color_network.decode` takes them."""
        directions = self.from_direction.weight
        return ColorNetwork(
            self.from_feature.weight,
            self.from_feature.bias,
            directions if self.learns_directions else directions.detach(),
            self.hidden.weight,
            self.hidden.bias,
            self.output.weight,
            self.output.bias,
            self.octaves,
        )

    def forward(
        self,
        features: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        precision: torch.dtype = torch.float32,
        residual: Tensor | None = None,
    ) -> Tensor:
        """RGB (S, 3) in [0, 1], as :func:`~devrf.ops.color_network.decode` gives it."""
        return decode(features, viewdirs, ray, self.network, precision, residual)

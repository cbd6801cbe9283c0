"""The colour decoder: interpolated features and viewing directions → RGB."""

from __future__ import annotations

from itertools import repeat

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

# Samples of a picture that are decoded at once on a CPU: a layer's outputs fit its caches
# (docs/notebook/costs.md).
TILE = 4096
# A layer with its activation by oneDNN, as torch's compiler calls it; None: torch lacks it.
LAYER = getattr(torch.ops.mkldnn, "_linear_pointwise", None)


class SigmoidColor(nn.Module):
    """Three channels are the colour itself, before a sigmoid: no network, no view dependence."""

    def forward(
        self,
        features: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
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
        """Two hidden layers of ``width`` units, and so many octaves k = 0 … of the direction."""
        super().__init__()
        self.register_buffer("octaves", 2.0 ** torch.arange(frequencies), persistent=False)
        self.from_feature = nn.Linear(channels, width)
        self.from_direction = nn.Linear(3 + 6 * frequencies, width, bias=False)
        self.hidden = nn.Linear(width, width)
        self.output = nn.Linear(width, 3)
        nn.init.zeros_(self.output.bias)
        self.learns_directions = True

    def forward(
        self,
        features: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        residual: Tensor | None = None,
    ) -> Tensor:
        """RGB (S, 3) in [0, 1] of samples.

        Args:
            features: (S, C) interpolated features.
            viewdirs: (R, 3) unit directions of the rays, in world space.
            ray: (S,) int64, ascending, the ray of each sample.
            residual: (S, 3) added before the sigmoid; None: nothing.
        """
        # The directions' part of the first layer is the same for all samples of a ray.
        row = ray
        if not torch.is_grad_enabled():
            # Most rays of a picture have no samples: their directions are not encoded.
            met, row = torch.unique_consecutive(ray, return_inverse=True)
            viewdirs = viewdirs.index_select(0, met)
        along = self._of_directions(viewdirs)
        if torch.is_grad_enabled() or not features.is_cpu or len(ray) <= TILE:
            return self._color(features, along.index_select(0, row), residual)
        added = repeat(None) if residual is None else torch.split(residual, TILE)
        tiles = zip(torch.split(features, TILE), torch.split(row, TILE), added, strict=False)
        return torch.cat(
            [self._color(tile, along.index_select(0, at), further) for tile, at, further in tiles]
        )

    def _of_directions(self, viewdirs: Tensor) -> Tensor:
        """The first layer's outputs (R, width) of directions d (R, 3) alone."""
        angles = (viewdirs[:, None, :] * self.octaves[:, None]).flatten(1)
        encoded = torch.cat([viewdirs, angles.sin(), angles.cos()], dim=-1)
        weight = self.from_direction.weight
        weight = weight if self.learns_directions else weight.detach()
        return linear(encoded, weight, self.from_feature.bias)

    def _color(self, features: Tensor, along: Tensor, residual: Tensor | None) -> Tensor:
        """RGB (S, 3) of features and directions' part of the first layer (S, width), overwritten.

        On a CPU oneDNN computes whole tiles, in two thirds of MKL's time (Intel, AVX-512). It would
        compile anew, in 0.2 ms, for any other number of samples.
        """
        # In place: no gradient needs a layer's output before its activation.
        x = along.addmm_(features, self.from_feature.weight.t()).relu_()
        hidden, output = self.hidden, self.output
        tile = len(x) == TILE and x.is_cpu and x.dtype == torch.float32
        if tile and LAYER is not None and not torch.is_grad_enabled():
            x = LAYER(x, hidden.weight, hidden.bias, "relu", [], "")
            logits = LAYER(x, output.weight, output.bias, "none", [], "")
        else:
            logits = output(hidden(x).relu_())
        if residual is not None:
            logits += residual
        return torch.sigmoid_(logits)

"""The colour network: interpolated features and viewing directions → RGB.

See docs/method.md#colour.
"""

from __future__ import annotations

from itertools import repeat
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear

# Samples of a picture that are decoded at once on a CPU: a layer's outputs fit its caches
# (docs/notebook/costs.md).
TILE = 4096
# A layer with its activation by oneDNN, as torch's compiler calls it; None: torch lacks it.
LAYER = getattr(torch.ops.mkldnn, "_linear_pointwise", None)


class ColorNetwork(NamedTuple):
    """c = sigmoid(MLP(f, d, sin(2^k d), cos(2^k d))), of two hidden layers of H units.

    Attributes:
        feature_weight: (H, C) of the first layer, for features.
        feature_bias: (H,) of the first layer.
        direction_weight: (H, 3 + 6F) of the first layer, for encoded directions.
        hidden_weight: (H, H).
        hidden_bias: (H,).
        output_weight: (3, H).
        output_bias: (3,).
        octaves: (F,) 2^k.
    """

    feature_weight: Tensor
    feature_bias: Tensor
    direction_weight: Tensor
    hidden_weight: Tensor
    hidden_bias: Tensor
    output_weight: Tensor
    output_bias: Tensor
    octaves: Tensor


def decode(
    features: Tensor,
    viewdirs: Tensor,
    ray: Tensor,
    network: ColorNetwork,
    residual: Tensor | None = None,
) -> Tensor:
    """RGB (S, 3) in [0, 1] of samples.

    Args:
        features: (S, C) interpolated features.
        viewdirs: (R, 3) unit directions of the rays, in world space.
        ray: (S,) int64, ascending, the ray of each sample.
        network: the network.
        residual: (S, 3) added before the sigmoid; None: nothing.
    """
    # The directions' part of the first layer is the same for all samples of a ray.
    row = ray
    if not torch.is_grad_enabled():
        # Most rays of a picture have no samples: their directions are not encoded.
        met, row = torch.unique_consecutive(ray, return_inverse=True)
        viewdirs = viewdirs.index_select(0, met)
    encoded = _encode(viewdirs, network.octaves)
    along = linear(encoded, network.direction_weight, network.feature_bias)
    if torch.is_grad_enabled() or not features.is_cpu or len(ray) <= TILE:
        return _color(features, along.index_select(0, row), network, residual)
    added = repeat(None) if residual is None else torch.split(residual, TILE)
    tiles = zip(torch.split(features, TILE), torch.split(row, TILE), added, strict=False)
    return torch.cat(
        [_color(tile, along.index_select(0, at), network, further) for tile, at, further in tiles]
    )


def _color(
    features: Tensor,
    along: Tensor,
    network: ColorNetwork,
    residual: Tensor | None,
) -> Tensor:
    """RGB (S, 3) of features (S, C) and directions' part of the first layer (S, H), overwritten."""
    # In place: no gradient needs a layer's output before its activation.
    x = along.addmm_(features, network.feature_weight.t()).relu_()
    logits = _logits(x, network)
    if residual is not None:
        logits += residual
    return torch.sigmoid_(logits)


def _logits(x: Tensor, network: ColorNetwork) -> Tensor:
    """The last layer's outputs (S, 3) for ``x`` (S, H), the first hidden layer's outputs.

    On a CPU oneDNN computes whole tiles, in two thirds of MKL's time (Intel, AVX-512). It would
    compile anew, in 0.2 ms, for any other number of samples.
    """
    weight, bias = network.output_weight, network.output_bias
    tile = len(x) == TILE and x.is_cpu and weight.dtype == torch.float32
    if tile and LAYER is not None and not torch.is_grad_enabled():
        hidden = LAYER(x, network.hidden_weight, network.hidden_bias, "relu", [], "")
        logits: Tensor = LAYER(hidden, weight, bias, "none", [], "")
        return logits
    return linear(linear(x, network.hidden_weight, network.hidden_bias).relu_(), weight, bias)


def _encode(viewdirs: Tensor, octaves: Tensor) -> Tensor:
    angles = (viewdirs[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([viewdirs, angles.sin(), angles.cos()], dim=-1)

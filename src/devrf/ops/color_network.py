"""The colour network: interpolated features and viewing directions → RGB.

See docs/method.md#colour.
"""

from __future__ import annotations

from itertools import repeat
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear

# Samples of a picture whose colours are found at once on a CPU: what a layer gives them fits its
# caches (docs/notebook/costs.md).
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
    precision: torch.dtype = torch.float32,
    residual: Tensor | None = None,
) -> Tensor:
    """RGB (S, 3) in [0, 1] of samples.

    Args:
        features: (S, C) interpolated features.
        viewdirs: (R, 3) unit directions of the rays, in world space.
        ray: (S,) int64, ascending, the ray of each sample.
        network: the network.
        precision: what the hidden layers and their gradients are computed in. Weights,
            sums, and the last layer stay in single precision, so that colours do.
        residual: (S, 3) what is added before the sigmoid; None: nothing.
    """
    # The directions' part of the first layer is the same for all samples of a ray.
    place = ray
    if not torch.is_grad_enabled():
        # Most rays of a picture have no samples: their directions are not encoded.
        seen, place = torch.unique_consecutive(ray, return_inverse=True)
        viewdirs = viewdirs.index_select(0, seen)
    encoded = _encode(viewdirs, network.octaves)
    along = linear(encoded, network.direction_weight, network.feature_bias)
    if torch.is_grad_enabled() or not features.is_cpu or len(ray) <= TILE:
        return _color(features, along.index_select(0, place), network, precision, residual)
    added = repeat(None) if residual is None else torch.split(residual, TILE)
    tiles = zip(torch.split(features, TILE), torch.split(place, TILE), added, strict=False)
    return torch.cat(
        [
            _color(tile, along.index_select(0, at), network, precision, further)
            for tile, at, further in tiles
        ]
    )


def _color(
    features: Tensor,
    along: Tensor,
    network: ColorNetwork,
    precision: torch.dtype,
    residual: Tensor | None,
) -> Tensor:
    """RGB (S, 3) of features (S, C) and directions' part of the first layer (S, H), overwritten."""
    if precision != torch.float32:
        along = along.to(precision)
    weight = network.feature_weight.to(along.dtype)
    # In place: no layer's gradient needs what it gave before its activation.
    x = along.addmm_(features.to(along.dtype), weight.t()).relu_()
    logits = _logits(x, network)
    if residual is not None:
        logits += residual
    return torch.sigmoid_(logits)


def _logits(x: Tensor, network: ColorNetwork) -> Tensor:
    """What the second hidden and the last layer give to ``x`` (S, H).

    Of a whole tile on a CPU by oneDNN, in two thirds of MKL's time (Intel, AVX-512). Other numbers
    of samples it would compile for anew, in 0.2 ms.
    """
    weight, bias = network.output_weight, network.output_bias
    tile = len(x) == TILE and x.is_cpu and x.dtype == weight.dtype == torch.float32
    if tile and LAYER is not None and not torch.is_grad_enabled():
        hidden = LAYER(x, network.hidden_weight, network.hidden_bias, "relu", [], "")
        logits: Tensor = LAYER(hidden, weight, bias, "none", [], "")
        return logits
    x = linear(x, network.hidden_weight.to(x.dtype), network.hidden_bias.to(x.dtype)).relu_()
    return linear(x.to(weight.dtype), weight, bias)


def _encode(viewdirs: Tensor, octaves: Tensor) -> Tensor:
    angles = (viewdirs[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([viewdirs, angles.sin(), angles.cos()], dim=-1)

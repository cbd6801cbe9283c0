"""The colour network: interpolated features and viewing directions → RGB.

See docs/method.md#colour. In one pass over listed samples where Triton runs, without what lies
between its layers: the backward pass computes that once more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx
from torch.nn.functional import linear

from devrf.ops.corners import Corners, axes_of, shape_of, to_grid
from devrf.ops.dispatch import accelerated
from devrf.ops.trilinear import interpolate, kept_gradient

# The widest hidden layers that a program's registers have room for.
WIDEST = {torch.float32: 32, torch.bfloat16: 128, torch.float16: 128}


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


def listed_colors(
    grid: Tensor,
    points: Tensor,
    box: Corners,
    viewdirs: Tensor,
    ray: Tensor,
    first: Tensor,
    network: ColorNetwork,
    precision: torch.dtype = torch.float32,
) -> Tensor:
    """RGB (S, 3) in [0, 1] of samples in a list of fixed length; anything finite in its padding.

    Gradients of the grid and of the network that exist already are added to in place.

    Args:
        grid: (X, Y, Z, C) features.
        points: (S, 3) positions in the box's units.
        box: the box of the grid.
        viewdirs: (R, 3) unit directions of the rays, in world space.
        ray: (S,) int64, the ray of each sample.
        first: (R + 1,) where each ray's samples begin; places from first[R] on are padding.
        network: the network; what of it needs no gradient gets none.
        precision: as for :func:`decode`.
    """
    # Triton's interpreter, the one that runs on a CPU, cannot multiply bfloat16.
    multiplied = precision != torch.bfloat16 or points.device.type != "cpu"
    learned = grid, *network[:7]
    suits = multiplied and len(network.hidden_bias) <= WIDEST.get(precision, 0)
    if suits and (kernels := accelerated("color_network", points, viewdirs, *learned)):
        known = points, grid, axes_of(box, grid), viewdirs, network.octaves, ray, first
        accumulated = [kept_gradient(leaf) for leaf in learned]
        colors: Tensor = kernels.listed_colors(*known, precision, accumulated, *network[:7])
        return colors
    coords = to_grid(points, box, shape_of(grid))
    features = interpolate(grid, coords, gradient=kept_gradient(grid))
    return decode(features, viewdirs, ray, network, precision)


def decode(
    features: Tensor,
    viewdirs: Tensor,
    ray: Tensor,
    network: ColorNetwork,
    precision: torch.dtype = torch.float32,
    residual: Tensor | None = None,
) -> Tensor:
    """RGB (S, 3) in [0, 1] of samples.

    The first layer is split: its direction part is computed once a ray, not once a sample.

    Args:
        features: (S, C) interpolated features.
        viewdirs: (R, 3) unit directions of the rays, in world space.
        ray: (S,) int64, the ray of each sample.
        network: the network.
        precision: what the hidden layers and their gradients are computed in. Weights,
            sums, and the last layer stay in single precision, so that colours do.
        residual: (S, 3) what is added before the sigmoid; None: nothing.
    """
    encoded = _encode(viewdirs, network.octaves)
    by_ray = _linear(encoded, network.direction_weight, None, precision)
    from_ray: Tensor = RowOfRay.apply(by_ray, ray)  # type: ignore[no-untyped-call]
    # In place: no layer's gradient needs what it gave before its activation.
    x = _linear(features, network.feature_weight, network.feature_bias, precision)
    x = x.add_(from_ray).relu_()
    x = _linear(x, network.hidden_weight, network.hidden_bias, precision).relu_()
    logits = linear(x.to(network.output_weight.dtype), network.output_weight, network.output_bias)
    if residual is not None:
        logits += residual
    return torch.sigmoid_(logits)


def _encode(viewdirs: Tensor, octaves: Tensor) -> Tensor:
    angles = (viewdirs[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([viewdirs, angles.sin(), angles.cos()], dim=-1)


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None, precision: torch.dtype) -> Tensor:
    """A layer of ``x`` (S, C), computed in ``precision``; float32 leaves it its own."""
    if precision == torch.float32:
        return linear(x, weight, bias)
    reduced = None if bias is None else bias.to(precision)
    return linear(x.to(precision), weight.to(precision), reduced)


class RowOfRay(torch.autograd.Function):
    """rows[ray] (S, C) of ``rows`` (R, C); its gradient is summed over a ray in single precision.

    Many samples add to one row: sums of bfloat16 lose digits, and GPUs before sm_90 add them in
    loops of compare and swap.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, rows: Tensor, ray: Tensor) -> Tensor:
        """Look the rows up."""
        ctx.save_for_backward(ray)
        ctx.rays = len(rows)  # type: ignore[attr-defined]
        return rows.index_select(0, ray)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Sum over the samples of each ray."""
        (ray,) = ctx.saved_tensors
        sums = gradient.new_zeros((ctx.rays, gradient.shape[1]), dtype=torch.float32)
        return sums.index_add_(0, ray, gradient.float()).to(gradient.dtype), None

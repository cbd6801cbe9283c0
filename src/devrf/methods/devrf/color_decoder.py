"""Colour decoders: interpolated features and a viewing direction → RGB."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx


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

    The first layer is split: its direction part is computed once a ray, not once a sample.

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

    def forward(
        self,
        features: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        precision: torch.dtype = torch.float32,
        residual: Tensor | None = None,
    ) -> Tensor:
        """Colours of samples.

        Args:
            features: (S, C) interpolated features.
            viewdirs: (R, 3) unit directions of the rays, in world space.
            ray: (S,) int64, the ray of each sample.
            precision: what the hidden layers and their gradients are computed in. Weights,
                sums, and the last layer stay in single precision, so that colours do.
            residual: (S, 3) what is added before the sigmoid; None: nothing.

        Returns:
            RGB (S, 3) in [0, 1].
        """
        by_ray = _linear(self.from_direction, self._encode(viewdirs), precision)
        if not self.learns_directions:
            by_ray = by_ray.detach()
        from_ray: Tensor = RowOfRay.apply(by_ray, ray)  # type: ignore[no-untyped-call]
        # In place: no layer's gradient needs what it gave before its activation.
        x = _linear(self.from_feature, features, precision).add_(from_ray).relu_()
        x = _linear(self.hidden, x, precision).relu_()
        logits: Tensor = self.output(x.to(self.output.weight.dtype))
        if residual is not None:
            logits += residual
        return torch.sigmoid_(logits)

    def _encode(self, viewdirs: Tensor) -> Tensor:
        angles = (viewdirs[:, None, :] * self.octaves[:, None]).flatten(1)
        return torch.cat([viewdirs, angles.sin(), angles.cos()], dim=-1)


def _linear(layer: nn.Linear, x: Tensor, precision: torch.dtype) -> Tensor:
    """``layer`` of ``x`` (S, C), computed in ``precision``; float32 leaves the layer its own."""
    if precision == torch.float32:
        return torch.nn.functional.linear(x, layer.weight, layer.bias)
    bias = None if layer.bias is None else layer.bias.to(precision)
    return torch.nn.functional.linear(x.to(precision), layer.weight.to(precision), bias)


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

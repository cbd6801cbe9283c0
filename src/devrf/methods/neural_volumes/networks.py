"""Networks of Neural Volumes: an encoder of images, decoders of volumes, and warps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.ops.splatting import rotations

LEAK = 0.2
Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def xavier(layer: Layer, leak: float = LEAK) -> Layer:
    """``layer`` with Xavier's uniform weights; ``leak`` 1 for one without activation."""
    nn.init.xavier_uniform_(layer.weight, nn.init.calculate_gain("leaky_relu", leak))
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


def doubling(inputs: int, outputs: int, leak: float = LEAK) -> nn.ConvTranspose3d:
    """A transposed convolution that doubles a volume (4³, stride 2).

    Two of the four taps along an axis meet each voxel. Both pairs begin alike, so that all eight
    voxels that come of one are the same at first, without a checkerboard.
    """
    layer = nn.ConvTranspose3d(inputs, outputs, 4, 2, 1)
    bound = nn.init.calculate_gain("leaky_relu", leak) * (6 / (8 * (inputs + outputs))) ** 0.5
    with torch.no_grad():
        first = torch.empty(inputs, outputs, 2, 2, 2).uniform_(-bound, bound)
        for axis in (2, 3, 4):
            first = first.repeat_interleave(2, dim=axis)
        layer.weight.copy_(first)
        assert layer.bias is not None
        layer.bias.zero_()
    return layer


class VolumeDecoder(nn.Module):
    """A code → a volume, doubled level by level from 1³ (docs/methods/neural_volumes.md#decoder).

    Attributes:
        side: voxels along an edge of the volume.
    """

    def __init__(self, code: int, channels: Sequence[int], outputs: int) -> None:
        """Build the levels.

        Args:
            code: numbers in a code.
            channels: that each level reads, from 1³ on.
            outputs: values of a voxel.
        """
        super().__init__()
        levels: list[nn.Module] = [nn.LeakyReLU(LEAK)]
        for read, made in zip(channels, channels[1:], strict=False):
            levels += [doubling(read, made), nn.LeakyReLU(LEAK)]
        self.first = xavier(nn.Linear(code, channels[0]))
        self.levels = nn.Sequential(*levels)
        self.output = doubling(channels[-1], outputs, 1.0)
        self.side = 2 ** len(channels)

    def forward(self, code: Tensor) -> Tensor:
        """Volumes (M, outputs, side, side, side), the axes z, y, x, of codes (M, code)."""
        volume: Tensor = self.output(self.levels(self.first(code)[:, :, None, None, None]))
        return volume


# Colours are standardised as published: mean 100 and deviation 25 of 255.
MEAN = 100 / 255
DEVIATION = 25 / 255


class TimeEncoder(nn.Module):
    """K images of a moment → μ and log s of its code (docs/methods/neural_volumes.md#encoder)."""

    def __init__(self, settings: NeuralVolumesSettings) -> None:
        """Build a stack of convolutions for each camera, and the layers that join them."""
        super().__init__()
        s = settings
        stack = [3, *settings.encoder_channels]
        self.cameras = nn.ModuleList()
        for _ in range(s.encoder_views):
            layers: list[nn.Module] = []
            for read, made in zip(stack, stack[1:], strict=False):
                layers += [xavier(nn.Conv2d(read, made, 4, 2, 1)), nn.LeakyReLU(LEAK)]
            self.cameras.append(nn.Sequential(*layers, nn.Flatten()))
        height, width = (edge >> len(s.encoder_channels) for edge in s.encoder_size)
        joined = xavier(nn.Linear(s.encoder_views * stack[-1] * height * width, s.encoder_width))
        self.joined = nn.Sequential(joined, nn.LeakyReLU(LEAK))
        self.mean = xavier(nn.Linear(s.encoder_width, s.code), 1.0)
        self.log_deviation = xavier(nn.Linear(s.encoder_width, s.code), 1.0)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """μ and log s, (M, code) each.

        Args:
            images: (M, K, 3, H, W) RGB in [0, 1].
        """
        standard = (images - MEAN) / DEVIATION
        features = [camera(standard[:, k]) for k, camera in enumerate(self.cameras)]
        joined = self.joined(torch.cat(features, dim=1))
        return 0.1 * self.mean(joined), 0.01 * self.log_deviation(joined)


# The least length that a quaternion is divided by, so that 0 is no rotation.
LEAST_NORM = 1e-5**0.5
# The last layers of affine maps that begin next to the identity begin in ±SMALL.
SMALL = 1e-5


def identity_grid(side: int) -> Tensor:
    """(3, side, side, side): x, y, z of a grid over the cube [−1, 1]³, its axes z, y, x."""
    axis = torch.linspace(-1, 1, side)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return torch.stack([x, y, z])


class ConvWarp(nn.Module):
    """x + d(x), d decoded by transposed convolutions (docs/methods/neural_volumes.md#warp)."""

    grid: Tensor

    def __init__(self, settings: NeuralVolumesSettings) -> None:
        super().__init__()
        self.scale = settings.warp_scale
        self.decoder = VolumeDecoder(settings.code, settings.warp_channels, 3)
        self.register_buffer("grid", identity_grid(self.decoder.side), persistent=False)

    def forward(self, code: Tensor) -> Tensor:
        """Positions (M, 3, side, side, side) in the template, for codes (M, code)."""
        position: Tensor = self.grid + self.scale * self.decoder(code)
        return position


class AffineMixWarp(nn.Module):
    """A mixture of affine maps A_k(x) = s_k ⊙ R(q_k)(x − 0.1 t_k).

    The field is Σ w_k(A_k x) A_k x / Σ w_k(A_k x), with the weights w_k on a grid, whose border
    holds for all that is beyond (docs/methods/neural_volumes.md#warp).
    """

    grid: Tensor

    def __init__(self, settings: NeuralVolumesSettings) -> None:
        super().__init__()
        self.side = settings.warp_side
        self.maps = settings.maps

        def branch(width: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(
                xavier(nn.Linear(settings.code, width)),
                nn.LeakyReLU(LEAK),
                xavier(nn.Linear(width, outputs * settings.maps), 1.0),
            )

        self.scale = branch(128, 3)
        self.rotation = branch(128, 4)
        self.shift = branch(128, 3)
        self.weight = branch(64, settings.warp_side**3)
        if settings.identity_start:
            for last in (self.scale[-1], self.rotation[-1], self.shift[-1]):
                nn.init.uniform_(last.weight, -SMALL, SMALL)  # type: ignore[arg-type]
            nn.init.ones_(self.scale[-1].bias)  # type: ignore[arg-type]
        self.register_buffer("grid", identity_grid(settings.warp_side), persistent=False)

    def forward(self, code: Tensor) -> Tensor:
        """Positions (M, 3, side, side, side) in the template, for codes (M, code)."""
        count = len(code)
        side = self.side
        scale = self.scale(code).view(count, self.maps, 3, 1)
        rotation = rotations(self.rotation(code).view(count, self.maps, 4), least=LEAST_NORM)
        shift = 0.1 * self.shift(code).view(count, self.maps, 3, 1)
        moved = scale * (rotation @ (self.grid.flatten(1) - shift))  # (M, K, 3, side³)
        weight = self.weight(code).exp().view(count * self.maps, 1, side, side, side)
        position = moved.transpose(2, 3).reshape(count * self.maps, side, side, side, 3)
        mixing = grid_sample(weight, position, padding_mode="border", align_corners=True)
        mixing = mixing.view(count, self.maps, 1, -1)
        mixed: Tensor = (mixing * moved).sum(dim=1) / mixing.sum(dim=1).clamp(min=1e-3)
        return mixed.view(count, 3, side, side, side)

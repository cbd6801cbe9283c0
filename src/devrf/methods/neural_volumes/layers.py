"""What encoder, template and warp are made of: initialised layers, and a decoder of volumes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

LEAK = 0.2


def linear(inputs: int, outputs: int, leak: float = LEAK) -> nn.Linear:
    """A linear layer with Xavier's uniform weights; ``leak`` 1 for one without activation."""
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight, nn.init.calculate_gain("leaky_relu", leak))
    nn.init.zeros_(layer.bias)
    return layer


def halving(inputs: int, outputs: int) -> nn.Conv2d:
    """A convolution that halves an image (4×4, stride 2)."""
    layer = nn.Conv2d(inputs, outputs, 4, 2, 1)
    nn.init.xavier_uniform_(layer.weight, nn.init.calculate_gain("leaky_relu", LEAK))
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
        self.first, self.levels = linear(code, channels[0]), nn.Sequential(*levels)
        self.output = doubling(channels[-1], outputs, 1.0)
        self.side = 2 ** len(channels)

    def forward(self, code: Tensor) -> Tensor:
        """Volumes (M, outputs, side, side, side), the axes z, y, x, of codes (M, code)."""
        volume: Tensor = self.output(self.levels(self.first(code)[:, :, None, None, None]))
        return volume

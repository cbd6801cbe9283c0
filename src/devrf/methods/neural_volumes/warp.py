"""The warp: a code → where in the template each point of the cube is found."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.methods.neural_volumes.layers import LEAK, VolumeDecoder, linear

# A quaternion of this length or less counts as shorter than one: 0 is no rotation.
LEAST_NORM = 1e-5**0.5
# So small are the last layers of the affine maps at first: next to the identity.
SMALL = 1e-5


def identity_grid(side: int) -> Tensor:
    """(3, side, side, side): x, y, z of a grid over the cube [−1, 1]³, its axes z, y, x."""
    axis = torch.linspace(-1, 1, side)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return torch.stack([x, y, z])


class ConvWarp(nn.Module):
    """x + d(x), d decoded by transposed convolutions (docs/methods/neural_volumes.md#warp)."""

    grid: Tensor

    def __init__(self, code: int, channels: list[int], scale: float) -> None:
        """Build the decoder of displacements.

        Args:
            code: numbers in a code.
            channels: as of :class:`VolumeDecoder`.
            scale: displacement for an output of 1; the cube's edge is 2.
        """
        super().__init__()
        self.scale = scale
        self.decoder = VolumeDecoder(code, channels, 3)
        self.register_buffer("grid", identity_grid(self.decoder.side), persistent=False)

    def forward(self, code: Tensor) -> Tensor:
        """Positions (M, 3, side, side, side) in the template, for codes (M, code)."""
        found: Tensor = self.grid + self.scale * self.decoder(code)
        return found


class AffineWarp(nn.Module):
    """A mixture of affine maps A_k(x) = s_k ⊙ R(q_k)(x − 0.1 t_k).

    The field is Σ w_k(A_k x) A_k x / Σ w_k(A_k x), with the weights w_k on a grid
    (docs/methods/neural_volumes.md#warp). s_k = 1 + the network's output.
    """

    grid: Tensor

    def __init__(self, code: int, side: int, maps: int) -> None:
        """Build the networks of the maps and of their weights."""
        super().__init__()
        self.side, self.maps = side, maps
        self.scale, self.rotation, self.shift = (
            _small_network(code, 128, outputs * maps) for outputs in (3, 4, 3)
        )
        self.weight = nn.Sequential(
            linear(code, 64), nn.LeakyReLU(LEAK), linear(64, maps * side**3, 1.0)
        )
        self.register_buffer("grid", identity_grid(side), persistent=False)

    def forward(self, code: Tensor) -> Tensor:
        """Positions (M, 3, side, side, side) in the template, for codes (M, code)."""
        count, side = len(code), self.side
        scale = 1 + self.scale(code).view(count, self.maps, 3, 1)
        rotation = rotation_matrices(self.rotation(code).view(count, self.maps, 4))
        shift = 0.1 * self.shift(code).view(count, self.maps, 3, 1)
        moved = scale * (rotation @ (self.grid.flatten(1) - shift))  # (M, K, 3, side³)
        weight = self.weight(code).exp().view(count * self.maps, 1, side, side, side)
        place = moved.transpose(2, 3).reshape(count * self.maps, side, side, side, 3)
        there = nn.functional.grid_sample(weight, place, align_corners=True)
        there = there.view(count, self.maps, 1, -1)
        mixed: Tensor = (there * moved).sum(dim=1) / there.sum(dim=1).clamp(min=1e-3)
        return mixed.view(count, 3, side, side, side)


def rotation_matrices(quaternion: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4), w first, of any length; 0 is no rotation."""
    length = quaternion.square().sum(dim=-1, keepdim=True).clamp(min=LEAST_NORM**2).sqrt()
    w, x, y, z = (quaternion / length).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _small_network(code: int, width: int, outputs: int) -> nn.Sequential:
    last = nn.Linear(width, outputs)
    nn.init.uniform_(last.weight, -SMALL, SMALL)
    nn.init.zeros_(last.bias)
    return nn.Sequential(linear(code, width), nn.LeakyReLU(LEAK), last)

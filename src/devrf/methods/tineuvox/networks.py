"""The grid of TiNeuVox, looked up at several distances, and the network behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box
from devrf.kernels.trilinear import interpolate
from devrf.methods.nerf.networks import ColorBranch, SinusoidalEncoding, linear_by_ray
from devrf.methods.tineuvox.settings import TiNeuVoxSettings
from devrf.ops.trilinear import Shape, resample, shape_of


class MultiDistanceGrid(StoredShape):
    """Features of space, at several spacings of one grid (docs/methods/tineuvox.md#grid).

    Attributes:
        values: (X, Y, Z, C). X − 1, Y − 1, Z − 1 are multiples of the largest stride, so that
            the outer points of all spacings are on the faces of one box.
    """

    resizable: ClassVar = {"values": 3}
    values: nn.Parameter

    def __init__(self, channels: int, strides: Sequence[int]) -> None:
        """A grid of one cell of the largest stride, of zeros."""
        super().__init__()
        self.strides = tuple(strides)
        side = max(strides) + 1
        self.values = nn.Parameter(torch.zeros(side, side, side, channels))

    @property
    def shape(self) -> Shape:
        """Grid points along x, y, z."""
        return shape_of(self.values)

    def forward(self, points: Tensor, box: Box) -> Tensor:
        """Features (M, C · strides) at ``points`` (M, 3), one spacing after another.

        The grid is over ``box``; outside they are those of its border.
        """
        return torch.cat([interpolate(self.values, points, box, n) for n in self.strides], dim=1)

    def fitting(self, box: Box, side: float) -> Shape:
        """The least shape of about ``side``³ points over ``box`` that all strides fit into."""
        widest = max(self.strides)
        cells = [-(-(points - 1) // widest) for points in box.grid_shape(round(side**3))]
        x, y, z = (count * widest + 1 for count in cells)
        return x, y, z

    @torch.no_grad()
    def resize(self, shape: Shape) -> None:
        """Resample to another shape over the same box, trilinearly; a new parameter results."""
        values = resample(self.values, shape)
        self.values = nn.Parameter(values, requires_grad=self.values.requires_grad)


class RadianceNetwork(nn.Module):
    """(γ(features), γ(x), code) → density; with γ(d) → colour."""

    def __init__(self, settings: TiNeuVoxSettings, position: int, code: int) -> None:
        """For encoded positions and codes of these lengths."""
        super().__init__()
        s = settings
        self.encode_feature = SinusoidalEncoding(s.channels * len(s.strides), s.feature_bands)
        self.trunk = nn.Linear(self.encode_feature.size + position + code, s.width)
        self.density = nn.Linear(s.width, 1)
        self.color = ColorBranch(s.width, s.direction_bands)

    def hidden(self, features: Tensor, position: Tensor, code: Tensor, ray: Tensor) -> Tensor:
        """Hidden features (S, width), of density and colour, at S samples of rays ``ray`` (S,).

        Interpolated ``features`` (S, ·) and encoded ``position`` (S, ·) are the samples', ``code``
        (R, ·) the rays'.
        """
        parts = [self.encode_feature(features), position]
        return linear_by_ray(self.trunk, parts, code, ray).relu_()

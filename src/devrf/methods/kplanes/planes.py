"""Features of space and time on six planes, and terms that keep the planes simple."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from devrf.geometry.box import Box, constant
from devrf.kernels.trilinear import interpolate
from devrf.methods.kplanes.settings import Pairing

# Axes of the planes of space: xy, xz, yz.
SPACE = ((0, 1), (0, 2), (1, 2))
# Axes of the planes with time: zt, yt, xt. Each is paired, as in HexPlane, with the one of space
# that does not have its axis.
TIME = ((2, 3), (1, 3), (0, 3))


class SixPlanes(nn.Module):
    """f(x, y, z, t): bilinear values of six planes, multiplied, and joined over scales.

    See docs/methods/kplanes.md#planes. Three planes of a scale lie one behind another along the
    first axis of one grid, so that one interpolation serves them.

    Attributes:
        space: for each scale, of N points along x, y and z, a grid (3N, N, 1, C) of the planes of
            :data:`SPACE`, at first uniform in a range.
        time: for each scale a grid (3N, T, 1, C) of those of :data:`TIME`, of T points along time,
            at first 1.
        size: length of f.
    """

    def __init__(
        self,
        channels: int,
        resolutions: Sequence[int],
        time_resolution: int,
        *,
        highest: float = 0.5,
        pairing: Pairing = "product",
    ) -> None:
        """Draw planes of so many points along x, y and z, at each scale, and along time.

        The first values of the planes of space are between 0.1 and ``highest``.
        """
        super().__init__()
        self._pairing = pairing
        self.space = nn.ParameterList()
        self.time = nn.ParameterList()
        for points in resolutions:
            drawn = torch.empty(len(SPACE) * points, points, 1, channels).uniform_(0.1, highest)
            self.space.append(drawn)
            self.time.append(torch.ones(len(TIME) * points, time_resolution, 1, channels))
        self.size = len(resolutions) * channels * (1 if pairing == "product" else len(SPACE))

    def forward(self, points: Tensor) -> Tensor:
        """f (S, size) at ``points`` (S, 4), x, y, z and t in [0, 1]; outside as at the border."""
        share = points.clamp(0, 1)
        in_space, in_time = (_places(share, axes) for axes in (SPACE, TIME))
        joined: list[Tensor] = []
        for space, time in zip(self.space, self.time, strict=True):
            first, second, third = (_values(space, in_space) * _values(time, in_time)).unbind()
            product = self._pairing == "product"
            joined += [first * second * third] if product else [first, second, third]
        return torch.cat(joined, dim=1)

    def total_variation(self) -> Tensor:
        """Σ over planes of 2 · (mean squared differences along both axes)."""
        planes = [_apart(grid) for grid in (*self.space, *self.time)]
        return sum_of([2 * len(each) * _step(each, axis) for each in planes for axis in (1, 2)])

    def roughness(self) -> Tensor:
        """Σ over planes with time of the mean squared second difference along it."""
        steps = [grid.diff(dim=1) for grid in self.time]
        return len(TIME) * sum_of([_step(each, axis=1) for each in steps])

    def change(self) -> Tensor:
        """Σ over planes with time of the mean |1 − P|: 0 for a scene at rest."""
        return len(TIME) * sum_of([(1 - grid).abs().mean() for grid in self.time])


def sum_of(values: Sequence[Tensor]) -> Tensor:
    """The sum () of one or more values ()."""
    return torch.stack(list(values)).sum()


def _apart(grid: Tensor) -> Tensor:
    """The three planes (3, A, B, 1, C) in a grid."""
    return grid.view(len(SPACE), -1, *grid.shape[1:])


def _places(share: Tensor, axes: Sequence[tuple[int, int]]) -> Tensor:
    """(3, S, 2) of points ``share`` (S, 4): where they are on three planes with these axes."""
    along = share.unbind(1)
    return torch.stack([torch.stack([along[a], along[b]], dim=1) for a, b in axes])


def _values(grid: Tensor, share: Tensor) -> Tensor:
    """(3, S, C) of a grid's three planes at ``share`` (3, S, 2) of the ways along their axes."""
    _, rows, columns, _, channels = _apart(grid).shape
    last = constant((rows - 1.0, columns - 1.0), share.dtype, share.device)
    starts = constant(tuple(range(0, len(grid), rows)), share.dtype, share.device)
    row, column = (share * last).unbind(2)
    at = torch.stack([row + starts[:, None], column, torch.zeros_like(row)], dim=2)
    # Lengths are points of the grid. Along z it has one, and the same values.
    box = Box((0.0, 0.0, -1.0), (len(SPACE) * rows - 1.0, columns - 1.0, 1.0))
    return interpolate(grid, at.view(-1, 3), box).view(len(SPACE), -1, channels)


def _step(values: Tensor, axis: int) -> Tensor:
    """The mean squared difference of neighbours along an axis; 0 where it has none."""
    count = values.shape[axis] - 1
    if count < 1:
        return values.new_zeros(())
    # One operation and its gradient, in place of those of differences, squares and a mean.
    return mse_loss(values.narrow(axis, 1, count), values.narrow(axis, 0, count))

"""Features of space and time on six planes, and what keeps the planes simple."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from devrf.geometry.box import Box
from devrf.kernels.look_up import look_up
from devrf.methods.kplanes.settings import Pairing

# Axes of the planes: xy, xz, xt, yz, yt, zt.
AXES = tuple(combinations(range(4), 2))
TIME = 3
# HexPlane's pairs: xy with zt, xz with yt, yz with xt.
PAIRS = ((0, 5), (1, 4), (3, 2))
# Space and time are [−1, 1]⁴.
UNIT = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class SixPlanes(nn.Module):
    """f(x, y, z, t): bilinear values of six planes, multiplied, and joined over scales.

    See docs/methods/kplanes.md#planes.

    Attributes:
        planes: for each scale six grids (A, B, 1, C), A and B being points along the axes of
            :data:`AXES`; those of space begin uniform in a range, those with time at 1.
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
        self.planes = nn.ParameterList()
        for points in resolutions:
            sides = (points, points, points, time_resolution)
            for first, second in AXES:
                plane = torch.ones(sides[first], sides[second], 1, channels)
                self.planes.append(plane if second == TIME else plane.uniform_(0.1, highest))
        self.size = len(resolutions) * channels * (1 if pairing == "product" else len(PAIRS))

    def forward(self, points: Tensor) -> Tensor:
        """f (S, size) at ``points`` (S, 4), x, y, z and t in [−1, 1]; outside as at the border."""
        nothing = torch.zeros_like(points[:, 0])
        places = [torch.stack([points[:, a], points[:, b], nothing], dim=1) for a, b in AXES]
        joined: list[Tensor] = []
        for start in range(0, len(self.planes), len(AXES)):
            planes = self.planes[start : start + len(AXES)]
            values = [look_up(p, at, UNIT) for p, at in zip(planes, places, strict=True)]
            pairs = [values[first] * values[second] for first, second in PAIRS]
            joined += pairs if self._pairing == "hexplane" else [pairs[0] * pairs[1] * pairs[2]]
        return torch.cat(joined, dim=1)

    def along(self, *, time: bool) -> list[nn.Parameter]:
        """The planes whose second axis is ``time``, or is not."""
        return [p for n, p in enumerate(self.planes) if (TIME in AXES[n % len(AXES)]) == time]

    def total_variation(self) -> Tensor:
        """Σ over planes of 2 · (mean squared differences along both axes)."""
        return sum_of([2 * _step(plane, axis) for plane in self.planes for axis in (0, 1)])

    def roughness(self) -> Tensor:
        """Σ over planes with time of the mean squared second difference along it."""
        return sum_of([_step(plane.diff(dim=1), axis=1) for plane in self.along(time=True)])

    def change(self) -> Tensor:
        """Σ over planes with time of the mean |1 − P|: 0 of what is at rest."""
        return sum_of([(1 - plane).abs().mean() for plane in self.along(time=True)])


def sum_of(values: Sequence[Tensor]) -> Tensor:
    """The sum () of one or more values ()."""
    return torch.stack(list(values)).sum()


def _step(values: Tensor, axis: int) -> Tensor:
    """The mean squared difference of neighbours along an axis; 0 where it has none."""
    count = values.shape[axis] - 1
    if count < 1:
        return values.new_zeros(())
    # One operation and its gradient, in place of those of differences, squares and a mean.
    return mse_loss(values.narrow(axis, 1, count), values.narrow(axis, 0, count))

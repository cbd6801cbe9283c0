"""What is subtracted from a world far from the origin."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.offset import NO_OFFSET, added, offset_of, subtracted


def poses(positions: list[list[float]]) -> Tensor:
    axes = torch.eye(3, dtype=torch.float64).expand(len(positions), 3, 3)
    return torch.cat([axes, torch.tensor(positions, dtype=torch.float64)[:, :, None]], dim=2)


SQUARE = [[4.0, 0.0, 1.0], [0.0, 4.0, 1.0], [-4.0, 0.0, 1.0], [0.0, -4.0, 1.0]]


@pytest.mark.parametrize(
    ("far", "unit", "offset"),
    [
        ((0, 0, 0), 1, NO_OFFSET),
        ((600, 0, -600), 1, NO_OFFSET),  # float32 goes in steps of 6e-5 there
        ((500_003, 5_600_000, 200), 1, (500_000, 5_600_000, 200)),
        ((-4_000_000, 300_000, 4_900_000), 1, (-4_000_000, 300_000, 4_900_000)),
        ((500, 5600.01, 0.2), 1e-3, (500, 5600, 0.2)),  # kilometres
    ],
)
def test_the_offset_is_the_middle_rounded_to_the_spread(far, unit, offset):
    at = poses([[f + unit * v for f, v in zip(far, row, strict=True)] for row in SQUARE])
    assert offset_of(at) == pytest.approx(offset, rel=0, abs=10 * unit * any(offset))
    apart = (at[:, :, 3] - at[0, :, 3]).norm(dim=1)
    single = subtracted(at, offset_of(at)).float()[:, :, 3].double()
    torch.testing.assert_close((single - single[0]).norm(dim=1), apart, rtol=1e-4, atol=0)
    torch.testing.assert_close(added(subtracted(at, offset), offset), at, rtol=1e-15, atol=0)


def test_a_camera_that_stands_still_near_the_origin_is_not_far_away():
    assert offset_of(poses([[0.0, 0.0, 4.0]])) == NO_OFFSET
    assert offset_of(poses([[0.0, 0.0, 4.0], [1e-6, 0.0, 4.0]])) == NO_OFFSET
    assert offset_of(poses([[5e6, 0.0, 4.0]])) == (5e6, 0.0, 4.0)

"""Grid coordinates, to the bit those of geometry's boxes."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.ops.corners import to_grid

BOX = Box((-1.1, 0.3, -0.7), (0.9, 2.2, 1.3))
SHAPE = (7, 160, 33)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_is_what_the_box_says_to_the_bit(rng: torch.Generator, dtype: torch.dtype) -> None:
    points = torch.randn(500, 3, generator=rng, dtype=dtype)
    assert torch.equal(to_grid(points, BOX, SHAPE), BOX.to_grid(points, SHAPE))


def test_corners_by_hand() -> None:
    points = torch.tensor([BOX.low, BOX.middle, BOX.high])
    expected = torch.tensor([[0.0, 0.0, 0.0], [3.0, 79.5, 16.0], [6.0, 159.0, 32.0]])
    torch.testing.assert_close(to_grid(points, BOX, SHAPE), expected)

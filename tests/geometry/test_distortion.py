"""Lens distortion: by hand, against OpenCV, and against its own derivative."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from devrf.geometry.distortion import Distortion

PHONE = Distortion((0.1004, -0.209, 0.05, -0.01), (0.0011, -0.0026))
BARREL = Distortion((-0.28, 0.07, 0.0, 0.0), (-0.001, 0.002))


def square(side: float = 0.7, count: int = 15) -> torch.Tensor:
    """Points of a square around the axis, all its corners included."""
    axis = torch.linspace(-side, side, count, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis * 0.75, indexing="xy"), dim=-1)


def test_a_point_by_hand() -> None:
    lens = Distortion((0.1, 0.2, 0.3, 0.4), (0.01, 0.02))
    # r² = 5: g = 1 + 0.5 + 5 + 37.5 + 250 = 294; 2xy = 4.
    found = lens.distort(torch.tensor([1.0, 2.0]))
    expected = [294 + 0.04 + 0.02 * 7, 588 + 0.01 * 13 + 0.08]
    torch.testing.assert_close(found, torch.tensor(expected))


def test_no_coefficients_change_nothing() -> None:
    points = square()
    assert Distortion().none and not PHONE.none
    assert torch.equal(Distortion().distort(points), points)


def test_opencv_puts_points_in_the_same_places() -> None:
    points = square().reshape(-1, 2)
    (k1, k2, k3, _), tangential = BARREL.radial, BARREL.tangential
    ahead = torch.cat([points, torch.ones(len(points), 1)], dim=1).numpy()
    origin = np.zeros(3)
    theirs, _ = cv2.projectPoints(
        ahead, origin, origin, np.eye(3), np.array([k1, k2, *tangential, k3])
    )
    torch.testing.assert_close(BARREL.distort(points), torch.from_numpy(theirs[:, 0]))


def test_points_beyond_the_fold_are_not_upright() -> None:
    # r·(1 − r²/4) has its greatest value 0.7698 at r = 1.1547.
    lens = Distortion((-0.25, 0.0, 0.0, 0.0))
    fold = 2 / math.sqrt(3)
    x = torch.tensor([0.5, fold - 0.01, fold + 0.01, 3.0])
    points = torch.stack([x, torch.zeros(4)], dim=-1)
    assert lens.upright(points).tolist() == [True, True, False, False]


@pytest.mark.parametrize("lens", [PHONE, BARREL])
def test_the_slope_is_that_of_the_equation(lens: Distortion) -> None:
    point = torch.tensor([0.4, -0.3], dtype=torch.float64)
    slope = torch.func.jacrev(lens.distort)(point)
    xx, xy, yy = lens._jacobian(point)
    expected = torch.stack([torch.stack([xx, xy]), torch.stack([xy, yy])])
    torch.testing.assert_close(slope, expected)

"""Boxes: grids over them and rays across them."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.rays import Rays

Xyz = tuple[float, float, float]


def ray(origin: Xyz, direction: Xyz) -> Rays:
    d = torch.nn.functional.normalize(torch.tensor([direction]), dim=1)
    return Rays(torch.tensor([origin]), d, d)


def test_a_cube_of_side_cubed_voxels_has_that_side():
    # The paper's grids: cube roots in floating point must not lose one.
    for side in (2, 3, 10, 20, 40, 80, 100, 160, 161):
        for edge in (1.0, 2.26, 0.3):
            assert Box((0.0, 0.0, 0.0), (edge, edge, edge)).grid_shape(side**3) == (side,) * 3


@pytest.mark.parametrize(
    ("size", "voxels", "shape"),
    [
        ((4.0, 2.0, 1.0), 4096, (32, 16, 8)),  # s = (8 / 4096)^(1/3) = 1/8
        ((4.0, 2.0, 1.0), 990, (19, 9, 4)),  # a little more, rounded down
        ((100.0, 1.0, 1.0), 8, (43, 2, 2)),  # at least two along every axis
    ],
)
def test_a_grid_follows_the_box_proportions(size, voxels, shape):
    assert Box((0.0, 0.0, 0.0), size).grid_shape(voxels) == shape


def test_a_box_of_almost_no_thickness_has_no_grid():
    with pytest.raises(DevrfError, match=r"a box of \[0 0 0\] to \[1 1 1e\+18\] is too thin for"):
        Box((0.0,) * 3, (1.0, 1.0, 1e18)).grid_shape(1000)


def test_derived_boxes_by_hand():
    box, other = Box((0.0, 0.0, 0.0), (2.0, 4.0, 1.0)), Box((-1.0, 1.0, 0.5), (1.0, 5.0, 2.0))
    assert box.size == (2.0, 4.0, 1.0) and box.longest == 4.0 and box.volume == 8.0
    assert box.scaled(1.5) == Box((-0.5, -1.0, -0.25), (2.5, 5.0, 1.25))
    assert box.union(other) == Box((-1.0, 0.0, 0.0), (2.0, 5.0, 2.0))
    assert box.clipped(other) == Box((0.0, 1.0, 0.5), (1.0, 4.0, 1.0))


def test_a_flat_box_is_an_error():
    with pytest.raises(ValueError, match="low < high"):
        Box((0.0, 0.0, 0.0), (1.0, 1.0, 0.0))


def test_grid_points_sit_on_the_corners_and_to_grid_counts_them():
    box, shape = Box((-1.0, 0.0, 2.0), (1.0, 3.0, 2.5)), (5, 4, 2)
    points = box.grid_points(shape, torch.zeros(()))
    assert points.shape == (5, 4, 2, 3)
    torch.testing.assert_close(points[0, 0, 0], torch.tensor([-1.0, 0.0, 2.0]))
    torch.testing.assert_close(points[4, 3, 1], torch.tensor([1.0, 3.0, 2.5]))
    torch.testing.assert_close(points[1, 2, 0], torch.tensor([-0.5, 2.0, 2.0]))
    valid_mask = torch.cartesian_prod(*[torch.arange(float(n)) for n in shape])
    torch.testing.assert_close(box.to_grid(points.reshape(-1, 3), shape), valid_mask)


def test_contains_its_faces_and_nearest_moves_only_what_is_outside():
    box = Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = torch.tensor([[0.0, 2.0, 3.0], [0.5, 1.0, 1.0], [1.001, 1.0, 1.0], [-4.0, 9.0, 2.0]])
    assert box.contains(points).tolist() == [True, True, False, False]
    expected = torch.tensor([[0.0, 2.0, 3.0], [0.5, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 2.0, 2.0]])
    assert torch.equal(box.nearest(points), expected)


@pytest.mark.parametrize(
    ("origin", "direction", "entry", "leave"),
    [
        ((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.0, 4.0),
        # From the inside the entry lies behind the origin.
        ((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), -1.5, 0.5),
        # A diagonal through the middle.
        ((-2.0, -2.0, -2.0), (1.0, 1.0, 1.0), math.sqrt(3), 3 * math.sqrt(3)),
        # Away from the box: it is crossed behind the origin only.
        ((3.0, 0.0, 0.0), (1.0, 0.0, 0.0), -4.0, -2.0),
    ],
)
def test_crossing_by_hand(cube, origin, direction, entry, leave):
    got = cube.crossing(ray(origin, direction))
    assert [float(v) for v in got] == pytest.approx([entry, leave], rel=1e-5)


def test_a_miss_enters_after_it_leaves(cube):
    for rays in (
        ray((0.0, 0.0, 1.001), (0.6, 0.8, 0.0)),  # parallel above it
        ray((-3.0, 0.0, 0.0), (1.0, 1.0, 0.0)),  # slanted past a corner
    ):
        entry, leave = cube.crossing(rays)
        assert float(entry) > float(leave)

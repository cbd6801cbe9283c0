"""Occupancy: look-up, growth, bounding boxes, checkpoints."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.rendering.occupancy import Occupancy, bounding_box, dilate


def single(shape, at):
    mask = torch.zeros(shape, dtype=torch.bool)
    mask[at] = True
    return mask


def test_a_point_is_looked_up_at_its_nearest_grid_point():
    box = Box((0.0, 0.0, 0.0), (4.0, 3.0, 2.0))
    occupancy = Occupancy(single((5, 4, 3), (1, 2, 0)), box)
    points = torch.tensor(
        [[1.0, 2.0, 0.0], [1.45, 1.55, 0.45], [1.55, 2.0, 0.0], [1.0, 1.4, 0.0], [1.0, 2.0, 0.6]]
    )
    assert occupancy.at(points).tolist() == [True, True, False, False, False]


def test_dilate_grows_a_cube_and_stops_at_the_border():
    grown = dilate(single((7, 6, 5), (3, 1, 4)), 2)
    expected = torch.zeros(7, 6, 5, dtype=torch.bool)
    expected[1:6, 0:4, 2:5] = True
    assert torch.equal(grown, expected)
    assert torch.equal(dilate(expected, 0), expected)


def test_distances_are_those_along_the_farthest_axis_up_to_eight(cube):
    occupancy = Occupancy(single((20, 7, 9), (3, 2, 8)) | single((20, 7, 9), (19, 6, 0)), cube)
    cells = torch.cartesian_prod(torch.arange(20), torch.arange(7), torch.arange(9))
    away = [(cells - torch.tensor(one)).abs().amax(dim=1) for one in ((3, 2, 8), (19, 6, 0))]
    expected = torch.minimum(*away).clamp(max=8).view(20, 7, 9)
    distances = occupancy.distances
    assert distances.box == cube and distances.cells.dtype == torch.uint8
    assert torch.equal(distances.cells.long(), expected)
    assert Occupancy.FARTHEST == expected.max() == 8


def test_nothing_nearer_than_its_distance_is_occupied(rng):
    # What strides along a ray rely on; a grid with cells of unequal sides, points outside too.
    box = Box((0.0, 0.0, 0.0), (1.0, 2.0, 4.0))
    occupancy = Occupancy(torch.rand(9, 9, 9, generator=rng) < 0.012, box)
    points = torch.rand(400, 3, generator=rng) * torch.tensor([1.6, 2.6, 4.6]) - 0.3
    cells = occupancy.distances.at(points)
    assert torch.equal(cells == 0, occupancy.at(points))
    assert set(cells.tolist()) >= {0, 1, 2, 3} and cells.max() <= 8
    assert (cells[~box.scaled(1.3).contains(points)] == 1).all()
    # In so many cells less one along every axis nothing is met, and in a few more something is.
    edges = torch.tensor(box.size) / 8
    around = torch.rand(400, 300, 3, generator=rng) * 2 - 1
    empty = cells > 0
    for more, met in ((-1, False), (0.9, True)):
        reach = (cells[empty] + more)[:, None, None] * edges * 0.999
        probes = points[empty][:, None] + around[empty] * reach
        assert bool(occupancy.at(probes.view(-1, 3)).any()) == met


def test_the_shortest_edge_of_a_cell():
    mask = torch.ones(5, 5, 5, dtype=torch.bool)
    assert Occupancy(mask, Box((0.0, 0.0, 0.0), (1.0, 2.0, 4.0))).cell == 0.25


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        # Cells are 0.5, 0.5 and 0.25 wide.
        ([(1, 2, 3), (3, 3, 6)], ((-0.5, 0.0, -0.25), (0.5, 0.5, 0.5))),
        # A single grid point: a cell on both sides of it, as far as there are any.
        ([(2, 2, 4)], ((-0.5, -0.5, -0.25), (0.5, 0.5, 0.25))),
        ([(0, 0, 0)], ((-1.0, -1.0, -1.0), (-0.5, -0.5, -0.75))),
        ([(4, 4, 8)], ((0.5, 0.5, 0.75), (1.0, 1.0, 1.0))),
        ([], None),
    ],
)
def test_bounding_box_by_hand(cube, cells, expected):
    mask = torch.zeros(5, 5, 9, dtype=torch.bool)
    for cell in cells:
        mask[cell] = True
    assert bounding_box(mask, cube) == (expected and Box(*expected))


def test_a_stored_mask_of_other_shape_and_box_loads_with_its_distances(cube, rng):
    box = Box((-2.0, 0.0, 0.0), (2.0, 1.0, 3.0))
    stored = Occupancy(torch.rand(6, 4, 5, generator=rng) < 0.1, box)
    fresh = Occupancy.full((2, 2, 2), cube)
    assert not fresh.distances.cells.any()
    fresh.load_state_dict(stored.state_dict())
    assert fresh.box == fresh.distances.box == box
    assert torch.equal(fresh.mask, stored.mask)
    assert torch.equal(fresh.distances.cells, stored.distances.cells)
    points = torch.rand(200, 3, generator=rng) * 5 - 2.5
    assert torch.equal(fresh.at(points), stored.at(points))

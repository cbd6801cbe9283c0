"""The elastic prior: what it leaves alone, and what a strain costs, by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.elastic import elastic_energy as elastic
from devrf.methods.devrf.elastic import occupied_cells
from devrf.rendering.occupancy import Occupancy

BOX = Box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))
SHAPE = (3, 5, 4)


def moved_by(matrix: Tensor) -> Tensor:
    """The displacement of q → matrix · q + (1, 2, 3) on a grid over the box."""
    points = BOX.grid_points(SHAPE, matrix)
    return points @ matrix.T + torch.tensor([1.0, 2.0, 3.0]) - points


def everywhere() -> Tensor:
    return torch.ones(2, 4, 3)


def test_a_rigid_motion_costs_nothing() -> None:
    angle = 1.2
    turn = torch.eye(3)
    turn[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    assert elastic(moved_by(turn), BOX, everywhere()) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("matrix", "strain"),
    [
        # Stretched to 1.1 times its length along x: JᵀJ − I = diag(0.21, 0, 0).
        ([[1.1, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], 0.21**2),
        # Sheared by a fifth: JᵀJ − I has 0.2 twice off its diagonal and 0.04 on it.
        ([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], 2 * 0.2**2 + 0.04**2),
        # Flat: two of its three lengths are left.
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], 1.0),
    ],
)
def test_a_strain_costs_what_it_does_by_hand(matrix: list[list[float]], strain: float) -> None:
    found = elastic(moved_by(torch.tensor(matrix)), BOX, everywhere())
    assert float(found) == pytest.approx(strain * 0.1 / (strain + 0.1), rel=1e-4)


def test_cells_without_matter_do_not_count() -> None:
    grid = torch.zeros(*SHAPE, 3)
    grid[0, 0, 0, 0] = 0.5
    occupied = everywhere()
    assert elastic(grid, BOX, occupied) > 0
    occupied[0, 0, 0] = 0
    assert elastic(grid, BOX, occupied) == 0
    assert elastic(grid, BOX, 0 * occupied) == 0


def test_a_cell_is_occupied_if_any_point_in_it_is() -> None:
    mask = torch.zeros(5, 5, 5, dtype=torch.bool)
    mask[4, 0, 0] = True
    cells = occupied_cells(Occupancy(mask, BOX), BOX, (3, 3, 3))
    assert cells.sum() == 1 and cells[1, 0, 0] == 1

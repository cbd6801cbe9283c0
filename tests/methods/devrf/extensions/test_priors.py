"""The priors on the deformation: what they leave alone, and what strains and curves cost."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.extensions.priors import bending_energy as bending
from devrf.methods.devrf.extensions.priors import elastic_energy as elastic
from devrf.methods.devrf.extensions.priors import occupied_cells
from devrf.rendering.occupancy import Occupancy

BOX = Box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))
SHAPE, CURVED = (3, 5, 4), (5, 9, 7)
ALL_CELLS = torch.ones(4, 8, 6, dtype=torch.float64)


def moved_by(matrix: Tensor) -> Tensor:
    """The displacement of q → matrix · q + (1, 2, 3) on a grid over the box."""
    points = BOX.grid_points(SHAPE, matrix)
    return points @ matrix.T + torch.tensor([1.0, 2.0, 3.0]) - points


def test_a_rigid_motion_costs_nothing() -> None:
    angle = 1.2
    turn = torch.eye(3)
    turn[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    assert elastic(moved_by(turn), BOX, torch.ones(2, 4, 3)) == pytest.approx(0.0, abs=1e-9)


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
    found = elastic(moved_by(torch.tensor(matrix)), BOX, torch.ones(2, 4, 3))
    assert float(found) == pytest.approx(strain * 0.1 / (strain + 0.1), rel=1e-4)


def test_cells_without_matter_do_not_count() -> None:
    grid = torch.zeros(*SHAPE, 3)
    grid[0, 0, 0, 0] = 0.5
    occupied = torch.ones(2, 4, 3)
    assert elastic(grid, BOX, occupied) > 0
    occupied[0, 0, 0] = 0
    assert elastic(grid, BOX, occupied) == 0
    assert elastic(grid, BOX, 0 * occupied) == 0


def test_a_cell_is_occupied_if_any_point_in_it_is() -> None:
    mask = torch.zeros(5, 5, 5, dtype=torch.bool)
    mask[4, 0, 0] = True
    cells = occupied_cells(Occupancy(mask, BOX), BOX, (3, 3, 3))
    assert cells.sum() == 1 and cells[1, 0, 0] == 1


def points() -> Tensor:
    return BOX.grid_points(CURVED, torch.zeros((), dtype=torch.float64))


def test_a_uniform_stretch_turn_and_shear_cost_nothing() -> None:
    matrix = torch.tensor([[0.4, 0.3, 0.0], [-0.7, 0.1, 0.2], [0.0, 0.5, -0.3]]).double()
    moved = points() @ matrix + torch.tensor([1.0, 2.0, 3.0])
    assert float(bending(moved, BOX, ALL_CELLS)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "curved"),
    [
        # Δ_z = 0.3 x²: ∂_x ∂_x Δ_z = 0.6.
        (0, 0, 0.6**2),
        # Δ_z = 0.3 y z: ∂_y ∂_z Δ_z = ∂_z ∂_y Δ_z = 0.3.
        (1, 2, 2 * 0.3**2),
    ],
)
def test_a_curve_costs_what_it_does_by_hand(first: int, second: int, curved: float) -> None:
    at = points()
    moved = torch.zeros_like(at)
    moved[..., 2] = 0.3 * at[..., first] * at[..., second]
    # ℓ is a twentieth of the box's longest edge, 4.
    energy = 0.2**2 * curved
    expected = energy * 0.1 / (energy + 0.1)
    assert float(bending(moved, BOX, ALL_CELLS)) == pytest.approx(expected, rel=1e-9)


def test_points_away_from_matter_do_not_count() -> None:
    moved = torch.zeros(*CURVED, 3, dtype=torch.float64)
    moved[1, 1, 1, 0] = 0.5
    occupied = torch.zeros_like(ALL_CELLS)
    assert bending(moved, BOX, occupied) == 0
    occupied[-1, -1, -1] = 1  # its only corner inside the border is far from the bump
    assert bending(moved, BOX, occupied) == 0
    occupied[0, 0, 0] = 1
    assert bending(moved, BOX, occupied) > 0


def test_the_gradient_is_that_of_the_energy(rng: torch.Generator) -> None:
    moved = torch.rand(4, 5, 4, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    occupied = (torch.rand(3, 4, 3, generator=rng) > 0.4).double()
    assert torch.autograd.gradcheck(lambda grid: bending(grid, BOX, occupied), (moved,))

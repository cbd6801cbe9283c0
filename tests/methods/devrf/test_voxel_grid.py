"""Voxel grids over a box: look-up, resizing, checkpoints."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.canonical_field import VoxelGrid, resample

BOX = Box((-1.0, 0.0, 2.0), (3.0, 2.0, 3.0))


def linear(points: Tensor) -> Tensor:
    """Two linear functions of the position."""
    slope = torch.tensor([[1.0, -2.0], [0.5, 0.0], [3.0, 1.0]], dtype=points.dtype)
    return points @ slope + 0.25


def linear_grid(shape: tuple[int, int, int]) -> VoxelGrid:
    grid = VoxelGrid(shape, 2)
    with torch.no_grad():
        grid.values.copy_(linear(BOX.grid_points(shape, grid.values)))
    return grid


def inside(count: int, rng: torch.Generator) -> Tensor:
    low, high = BOX.corners(torch.zeros(()))
    return low + (high - low) * torch.rand(count, 3, generator=rng)


def test_a_linear_function_is_looked_up_exactly(rng: torch.Generator) -> None:
    points = inside(100, rng)
    torch.testing.assert_close(linear_grid((5, 4, 3))(points, BOX), linear(points))


@pytest.mark.parametrize("shape", [(9, 7, 5), (3, 2, 2), (5, 11, 3)])
def test_resizing_keeps_a_linear_function_exactly(
    shape: tuple[int, int, int], rng: torch.Generator
) -> None:
    grid, points = linear_grid((5, 4, 3)), inside(100, rng)
    grid.resize(shape)
    assert grid.shape == shape and grid.values.requires_grad and grid.values.is_leaf
    torch.testing.assert_close(grid(points, BOX), linear(points))


def test_doubling_cells_halves_the_steps_by_hand() -> None:
    values = torch.zeros(3, 2, 2, 1)
    values[1] = 2.0
    resized = resample(values, (5, 2, 2))[:, 0, 0, 0]
    torch.testing.assert_close(resized, torch.tensor([0.0, 1.0, 2.0, 1.0, 0.0]))


def test_resampling_to_the_same_shape_is_a_copy() -> None:
    values = torch.randn(3, 3, 3, 1, requires_grad=True)
    copied = resample(values, (3, 3, 3))
    assert torch.equal(copied, values) and copied.data_ptr() != values.data_ptr()


def test_a_stored_grid_of_another_shape_loads_whole(rng: torch.Generator) -> None:
    stored, fresh = VoxelGrid((4, 6, 3), 2), VoxelGrid((2, 2, 2), 2)
    torch.nn.init.normal_(stored.values, generator=rng)
    fresh.load_state_dict(stored.state_dict())
    assert fresh.shape == (4, 6, 3) and torch.equal(fresh.values, stored.values)
    assert isinstance(fresh.values, torch.nn.Parameter)


def test_a_resized_grid_lies_in_memory_as_a_new_one() -> None:
    # A single channel may keep a stray stride, which makes look-ups slow and not bit-equal.
    grid = VoxelGrid((3, 3, 3), 1)
    grid.resize((4, 5, 6))
    assert grid.values.stride() == VoxelGrid((4, 5, 6), 1).values.stride()

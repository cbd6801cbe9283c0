"""The 4D deformation field: identity at rest, 4-linear between frames, growth."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField

CLOCK = FrameClock((0.0, 0.2, 0.6, 1.0))


@pytest.fixture
def field(cube: Box) -> DeformationField:
    """Eight voxels a frame; frames 1 to 3 filled at random, frame 0 as it was built."""
    field = DeformationField(cube, CLOCK, voxels=8)
    field.backward_slices[1:].normal_()
    field.forward_slices[1:].normal_()
    return field


def points(count: int, rng: torch.Generator) -> Tensor:
    return 2 * torch.rand(count, 3, generator=rng) - 1


def test_time_zero_is_exactly_the_identity(field, rng):
    x = 1.5 * points(500, rng)
    assert torch.equal(field.backward_warp(0.0)(x), x)
    assert torch.equal(field.forward_warp(0.0)(x), x)


def test_between_frames_by_hand(cube):
    field = DeformationField(cube, CLOCK, voxels=8)
    # Frame 1 moves along x by 1 at the upper x face; frame 2 everything along y by 0.4.
    field.backward_slices[1, 1, :, :, 0] = 1.0
    field.backward_slices[2, ..., 1] = 0.4
    x = torch.tensor([[0.5, 0.0, 0.0], [-1.0, 0.2, 0.3]])
    # x = 0.5 lies 3/4 on the way between the faces; time 0.3 a quarter on from frame 1 to 2.
    on_frame = x + torch.tensor([[0.75, 0.0, 0.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(field.backward_warp(0.2)(x), on_frame)
    between = x + torch.tensor([[0.75 * 0.75, 0.1, 0.0], [0.0, 0.1, 0.0]])
    torch.testing.assert_close(field.backward_warp(0.3)(x), between)
    # Between rest and frame 1, half of frame 1.
    torch.testing.assert_close(field.backward_warp(0.1)(x), (x + on_frame) / 2)
    torch.testing.assert_close(field.forward_warp(0.3)(x), x)


@pytest.mark.parametrize("zero_outside_box", [False, True])
@pytest.mark.parametrize("time", [0.0, 0.2, 0.3])
def test_the_points_of_any_grid_are_moved_as_points_are(cube, time, zero_outside_box):
    field = DeformationField(cube, CLOCK, voxels=80, planes=3, zero_outside_box=zero_outside_box)
    field.backward_slices[1:].normal_()
    # A grid that reaches out of the field on some sides, one that shares its faces, one within.
    larger = Box((-1.5, -1.0, -0.5), (1.0, 2.0, 0.5))
    for box, shape in ((larger, (6, 7, 3)), (cube, (8, 5, 6)), (cube, field.shape)):
        warp = field.backward_warp(time)
        moved = warp.of_grid(box, shape, torch.device("cpu"))
        grid = box.grid_points(shape, torch.empty(0)).view(-1, 3)
        torch.testing.assert_close(moved, warp(grid), atol=1e-5, rtol=0)


@pytest.mark.parametrize("lost", [float("nan"), float("inf")])
def test_a_displacement_that_is_no_number_moves_only_what_is_around_it_out_of_the_box(cube, lost):
    field = DeformationField(cube, CLOCK, voxels=80, planes=3)
    field.backward_slices[1, 0, 0, 0, 1] = lost
    shape = tuple(2 * n - 1 for n in field.shape)
    moved = field.backward_warp(0.2).of_grid(cube, shape, torch.device("cpu")).view(*shape, 3)
    kept = moved == cube.grid_points(shape, moved)
    assert not cube.contains(moved[:2, :2, :2]).any()
    kept[:2, :2, :2] = True
    assert kept.all()


def test_resizing_keeps_a_linear_motion_exactly_and_frames_never_trained_zero(cube, rng):
    field = DeformationField(cube, CLOCK, voxels=27)
    turn = torch.tensor([[0.1, -0.3, 0.0], [0.2, 0.0, 0.1], [0.0, 0.5, -0.2]])
    field.backward_slices[2] = cube.grid_points(field.shape, turn) @ turn + 0.05
    x = points(100, rng)
    truth = x + x @ turn + 0.05
    for voxels in (1000, 64):
        field.resize(voxels)
        torch.testing.assert_close(field.backward_warp(0.6)(x), truth, atol=1e-5, rtol=0)
        for frame in (0, 1, 3):
            assert not field.backward_slices[frame].any()
        assert not field.forward_slices.any()
    assert field.shape == (4, 4, 4)

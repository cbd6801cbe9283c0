"""The 4D deformation field: identity at rest, 4-linear between frames, growth, slices."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.ops.trilinear import interpolate

CLOCK = FrameClock((0.0, 0.2, 0.6, 1.0))


@pytest.fixture
def field(cube: Box) -> DeformationField:
    """Eight voxels a frame; frames 1 to 3 filled at random, frame 0 as it was built."""
    field = DeformationField(cube, CLOCK, voxels=8)
    field.to_canonical[1:].normal_()
    field.to_time[1:].normal_()
    return field


def points(count: int, rng: torch.Generator) -> Tensor:
    return 2 * torch.rand(count, 3, generator=rng) - 1


def test_time_zero_is_exactly_the_identity(field: DeformationField, rng: torch.Generator) -> None:
    x = 1.5 * points(500, rng)
    assert torch.equal(field.warp(x, 0.0), x)
    assert torch.equal(field.unwarp(x, 0.0), x)


def test_a_new_field_rests_at_every_time(cube: Box, rng: torch.Generator) -> None:
    x = points(50, rng)
    field = DeformationField(cube, CLOCK, voxels=27)
    for time in (0.0, 0.1, 0.2, 0.77, 1.0):
        assert torch.equal(field.warp(x, time), x)


def test_between_frames_by_hand(cube: Box) -> None:
    field = DeformationField(cube, CLOCK, voxels=8)
    # Frame 1 moves along x by 1 at the upper x face; frame 2 everything along y by 0.4.
    field.to_canonical[1, 1, :, :, 0] = 1.0
    field.to_canonical[2, ..., 1] = 0.4
    x = torch.tensor([[0.5, 0.0, 0.0], [-1.0, 0.2, 0.3]])
    # x = 0.5 lies 3/4 on the way between the faces; time 0.3 a quarter on from frame 1 to 2.
    on_frame = x + torch.tensor([[0.75, 0.0, 0.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(field.warp(x, 0.2), on_frame)
    between = x + torch.tensor([[0.75 * 0.75, 0.1, 0.0], [0.0, 0.1, 0.0]])
    torch.testing.assert_close(field.warp(x, 0.3), between)
    # Between rest and frame 1, half of frame 1.
    torch.testing.assert_close(field.warp(x, 0.1), (x + on_frame) / 2)
    torch.testing.assert_close(field.unwarp(x, 0.3), x)


def test_time_runs_linearly_between_the_warps_of_two_frames(
    field: DeformationField, rng: torch.Generator
) -> None:
    x = points(100, rng)
    for name in ("warp", "unwarp"):
        move = getattr(field, name)
        mixed = 0.25 * move(x, 0.6) + 0.75 * move(x, 1.0)
        torch.testing.assert_close(move(x, 0.9), mixed, atol=1e-5, rtol=0)


def test_one_grid_stands_for_the_two_frames_around_a_time(
    field: DeformationField, rng: torch.Generator
) -> None:
    x = points(100, rng)
    for time in (0.0, 0.1, 0.3, 1.0):
        grid = field.blended(field.to_time, time)
        found = x + interpolate(grid, field.box.to_grid(x, field.shape))
        torch.testing.assert_close(found, field.unwarp(x, time))
    assert field.blended(field.to_time, 0.6).data_ptr() == field.to_time[2].data_ptr()


def test_every_frame_is_met_exactly_at_its_grid_points(field: DeformationField) -> None:
    corners = field.box.grid_points(field.shape, field.to_time).reshape(-1, 3)
    for k, time in enumerate(CLOCK.times):
        moved = corners + field.to_canonical[k].reshape(-1, 3)
        torch.testing.assert_close(field.warp(corners, time), moved)
        moved = corners + field.to_time[k].reshape(-1, 3)
        torch.testing.assert_close(field.unwarp(corners, time), moved)


def test_a_slice_trains_its_frame_in_place_and_no_other(field: DeformationField) -> None:
    before = field.to_canonical.clone(), field.to_time.clone()
    leaves = field.slice(2)
    optimizer = torch.optim.SGD(leaves, lr=1.0)
    torch.stack([leaf.sum() for leaf in leaves]).sum().backward()
    optimizer.step()
    for now, was in zip((field.to_canonical, field.to_time), before, strict=True):
        torch.testing.assert_close(now[2], was[2] - 1)
        assert torch.equal(now[[0, 1, 3]], was[[0, 1, 3]])
        assert not now.requires_grad


@pytest.mark.parametrize("frame", [0, 4, -1])
def test_the_rest_frame_and_frames_that_are_not_there_cannot_be_trained(
    field: DeformationField, frame: int
) -> None:
    with pytest.raises(IndexError, match="only 1 to 3"):
        field.slice(frame)


def test_carry_copies_the_frame_before_in_both_directions(field: DeformationField) -> None:
    before = field.to_canonical.clone(), field.to_time.clone()
    field.carry(2)
    for now, was in zip((field.to_canonical, field.to_time), before, strict=True):
        assert torch.equal(now[2], was[1])
        assert torch.equal(now[[0, 1, 3]], was[[0, 1, 3]])
    # A copy, not a view: what happens to frame 2 later is its own affair.
    field.to_canonical[2] += 1
    assert torch.equal(field.to_canonical[1], before[0][1])


def test_resizing_keeps_a_linear_motion_exactly_and_frames_never_trained_zero(
    cube: Box, rng: torch.Generator
) -> None:
    field = DeformationField(cube, CLOCK, voxels=27)
    turn = torch.tensor([[0.1, -0.3, 0.0], [0.2, 0.0, 0.1], [0.0, 0.5, -0.2]])
    field.to_canonical[2] = cube.grid_points(field.shape, turn) @ turn + 0.05
    x = points(100, rng)
    truth = x + x @ turn + 0.05
    for voxels in (27, 1000, 64):
        field.resize(voxels)
        torch.testing.assert_close(field.warp(x, 0.6), truth, atol=1e-5, rtol=0)
        for frame in (0, 1, 3):
            assert not field.to_canonical[frame].any()
        assert not field.to_time.any()
    assert field.shape == (4, 4, 4)


def test_resizing_leaves_the_corners_in_place(field: DeformationField) -> None:
    before = field.to_time[:, ::1, ::1, ::1].clone()
    field.resize(343)
    assert field.shape == (7, 7, 7)
    torch.testing.assert_close(field.to_time[:, ::6, ::6, ::6], before)


def test_a_stored_field_of_other_shape_clock_and_box_loads_bit_equal(
    field: DeformationField, rng: torch.Generator
) -> None:
    other = Box((0.0, 0.0, 0.0), (2.0, 1.0, 1.0))
    fresh = DeformationField(other, FrameClock((0.0, 1.0)), voxels=1000)
    fresh.load_state_dict(field.state_dict())
    assert fresh.clock == CLOCK and fresh.box == field.box
    x = points(50, rng)
    for time in (0.0, 0.15, 0.6, 0.85, 1.0):
        assert torch.equal(fresh.warp(x, time), field.warp(x, time))
        assert torch.equal(fresh.unwarp(x, time), field.unwarp(x, time))


def test_all_that_is_learned_is_in_the_state_dict(field: DeformationField) -> None:
    assert {"to_canonical", "to_time"} <= set(field.state_dict())
    # No optimiser may take the frames from the module: they are trained slice by slice.
    assert list(field.parameters()) == []


@pytest.mark.parametrize("half", [False, True])
def test_frames_that_rest_elsewhere_are_taken_out_as_the_field_works(
    field: DeformationField, rng: torch.Generator, half: bool
) -> None:
    x, times = points(50, rng), (0.1, 0.2, 0.77)
    expected = [(field.warp(x, t), field.blended(field.to_canonical, t)) for t in times]
    field.rest(on_host=True, half=half)
    close = {"atol": 2e-3, "rtol": 1e-3} if half else {"atol": 0.0, "rtol": 0.0}
    for time, (moved, grid) in zip(times, expected, strict=True):
        torch.testing.assert_close(field.warp(x, time), moved, **close)
        torch.testing.assert_close(field.blended(field.to_canonical, time), grid, **close)
    # Wherever the module goes, its frames stay as they are.
    resting = field.to_time
    field.double()
    assert field.to_time is resting and resting.dtype == (torch.half if half else torch.float)
    assert field.warp(x.double(), 0.77).dtype == torch.float64
    field.float().resize(27)
    assert field.to_time.dtype == resting.dtype and field.shape == (3, 3, 3)


def test_a_frame_is_read_changed_and_written_back(field: DeformationField) -> None:
    before = field.to_canonical.clone(), field.to_time.clone()
    pair = torch.empty(*field.shape, 3), torch.empty(*field.shape, 3)
    field.read(2, pair)
    assert torch.equal(pair[0], before[0][2]) and torch.equal(pair[1], before[1][2])
    pair[0].add_(1)
    assert torch.equal(field.to_canonical, before[0])
    field.write(2, pair)
    assert torch.equal(field.to_canonical[2], before[0][2] + 1)
    assert torch.equal(field.to_canonical[[0, 1, 3]], before[0][[0, 1, 3]])
    assert torch.equal(field.to_time, before[1])
    with pytest.raises(IndexError, match="only 1 to 3"):
        field.write(0, pair)


def test_what_is_on_its_way_counts_no_more_once_it_has_been_written(
    field: DeformationField,
) -> None:
    pair, stream = (field.to_canonical[1], field.to_time[1]), object()
    field._coming = {1: (pair, stream), 2: (pair, stream)}  # type: ignore[dict-item]
    field.write(1, pair)
    assert list(field._coming) == [2]
    field.resize(4**3)
    assert field._coming == {}


def test_what_is_on_its_way_from_the_host_is_not_copied(field: DeformationField) -> None:
    stream: Any = (number for number in ())  # like a stream, nothing that can be copied
    field._coming = {1: ((field.to_time[1], field.to_time[1]), stream)}
    assert copy.deepcopy(field)._coming == {}
    field._coming = {}

"""Candidates that a frame's visit starts from."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.deformation_schedule import (
    DeformationPhase,
    DeformationSchedule,
    Level,
    Visits,
)
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions import frame_start
from devrf.methods.devrf.extensions.frame_start import (
    StartFromBest,
    candidates,
    carried,
    smoothed,
)
from devrf.methods.devrf.frame_store import FrameStore

# Four frames. Level 0: 1, 2, 3 in iterations 0, 2, 3; level 1: 3, 2, 1 in 4, 6, 7.
BACK = Visits(DeformationSchedule((Level(2, 1), Level(2, 1, backwards=True))), frames=4)


@pytest.fixture
def stage(cube: Box) -> Any:
    """A stage as far as candidates see it."""
    frames = FrameStore(4, (2, 2, 2))
    field = SimpleNamespace(
        frames=frames,
        shape=frames.shape,
        clock=FrameClock((0.0, 0.2, 0.4, 1.0)),
        box=cube,
        backward_slices=frames.backward_slices,
        forward_slices=frames.forward_slices,
    )
    return SimpleNamespace(field=field, generator=None)


def phase(iteration: int) -> DeformationPhase:
    return BACK.phase(iteration)


@pytest.mark.parametrize(
    ("iteration", "frame", "names"),
    [
        (0, 1, ["own"]),  # there is nothing before the scene at rest
        (3, 3, ["own", "carried along", "carried along, smoothed"]),
        (4, 3, ["own"]),  # backwards the last frame is the first
        (6, 2, ["own", "as before"]),
        (7, 1, ["own", "as before", "carried along", "carried along, smoothed"]),
    ],
)
def test_what_a_visit_may_start_from(stage, iteration, frame, names):
    assert phase(iteration).frame == frame
    assert list(candidates(stage, phase(iteration))) == names


def test_what_is_carried_along_goes_as_far_as_its_time_says(stage):
    # 0.1 in the time from 0.2 to 0.4; three times as long is left to the last frame.
    stage.field.frames.write(2, (torch.full((2, 2, 2, 3), -0.1), torch.full((2, 2, 2, 3), 0.1)))
    backward, forward = candidates(stage, phase(3))["carried along"]
    torch.testing.assert_close(forward, torch.full((2, 2, 2, 3), 0.4))
    torch.testing.assert_close(backward, torch.full((2, 2, 2, 3), -0.4))


def test_the_candidate_of_the_least_error_is_what_the_frame_gets(stage, monkeypatch):
    starts = {
        name: (torch.full((2, 2, 2, 3), value), torch.full((2, 2, 2, 3), -value))
        for name, value in (("own", 1.0), ("as before", 2.0), ("carried along", 3.0))
    }
    monkeypatch.setattr(frame_start, "candidates", lambda *_: starts)
    errors = {1.0: 0.3, 2.0: 0.1, 3.0: 0.2}
    monkeypatch.setattr(StartFromBest, "_batch", lambda *_: None)
    monkeypatch.setattr(StartFromBest, "_error", lambda *of: errors[float(of[-1][0][0, 0, 0, 0])])
    StartFromBest(levels=1).initialise(stage, phase(7))  # of the second level
    assert not stage.field.forward_slices.any()
    StartFromBest(levels=2).initialise(stage, phase(7))
    assert (stage.field.backward_slices[1] == 2).all()
    assert (stage.field.forward_slices[1] == -2).all()
    assert not stage.field.forward_slices[2:].any()


@pytest.mark.parametrize(
    ("with_flow", "flow", "frames"),
    [(True, True, [1, 2]), (False, True, []), (False, False, [1, 2])],
)
def test_where_flow_tells_the_motion_candidates_can_be_left_out(
    with_flow, flow, frames, rest, tiny_scene, fit, serve, monkeypatch
):
    compared = []

    def noted(context, phase):
        compared.append(phase.frame)
        return candidates(context, phase)

    monkeypatch.setattr(frame_start, "candidates", noted)
    scene = tiny_scene
    if not flow:
        views = replace(scene.dynamic.train, flow=None)
        scene = replace(scene, dynamic=replace(scene.dynamic, train=views))
    levels = DeformationSchedule([Level(4, 1), Level(6, 1)], rays=16)
    start = StartFromBest(levels=1, with_flow=with_flow, rays=64)
    fit(DeformationStage(rest, levels, extensions={"frame_start": start}), data=serve(scene))
    assert compared == frames


def test_a_translation_goes_on_as_it_was(cube: Box):
    way = torch.tensor([0.1, -0.2, 0.05])
    at_rest = torch.zeros(5, 5, 5, 3)
    backward, forward = carried((at_rest - way, at_rest + way), at_rest + way, cube)
    assert torch.allclose(forward, (2 * way).expand(5, 5, 5, 3))
    assert torch.allclose(backward, (-2 * way).expand(5, 5, 5, 3))


def test_both_directions_stay_each_others_inverse(cube: Box):
    # A turn about z by a at one frame, carried on by what the turn from a to 2 a is.
    points = cube.grid_points((15, 15, 15), torch.zeros(()))

    def turn(angle: float) -> torch.Tensor:
        c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
        matrix = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return points @ matrix.T - points

    first = (turn(-0.1), turn(0.1))
    backward, forward = carried(first, turn(0.2) - turn(0.1), cube)
    assert torch.allclose(forward, turn(0.2), atol=1e-6)
    inner = points[4:11, 4:11, 4:11].reshape(-1, 3)
    there = inner + interpolate(forward, inner, cube)
    back = there + interpolate(backward, there, cube)
    assert (back - inner).norm(dim=1).amax() < 2e-3


def test_smoothed_by_hand():
    grid = torch.zeros(3, 3, 3, 1)
    grid[0, 0, 0] = 8.0
    means = smoothed(grid)
    assert means[0, 0, 0, 0] == pytest.approx(8 * 8 / 27)  # a corner counts eight times
    assert means[1, 1, 1, 0] == pytest.approx(8 / 27)
    assert means[2, 2, 2, 0] == 0
    assert torch.equal(smoothed(torch.ones(2, 3, 2, 3)), torch.ones(2, 3, 2, 3))

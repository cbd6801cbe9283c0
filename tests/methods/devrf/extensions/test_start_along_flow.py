"""Starting a frame from the observed optical flow."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from devrf.engine.graphs import Work
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.extensions.tracks import Tracks, start_from_tracks

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
SHIFT = torch.tensor([0.3, -0.2, 0.1])


def three_cameras() -> Cameras:
    positions = torch.tensor([[4.0, 0.0, 1.0], [0.0, 4.0, 1.0], [-3.0, -2.5, 1.5]])
    return Cameras.looking_at(positions, torch.zeros(3, 3), focal=120.0, width=100, height=80)


def shifted_ball(cameras: Cameras, radius: float = 0.4, count: int = 900) -> Tracks:
    """Points of a ball at rest, each seen by one camera once the ball has moved by SHIFT."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    points = radius * torch.nn.functional.normalize(points, dim=1)
    camera = torch.arange(count) % len(cameras)
    pixel, _ = cameras.project(camera, points + SHIFT)
    return Tracks(points, camera, pixel)


def test_three_views_of_a_shift_give_the_shift_and_the_way_back() -> None:
    field = DeformationField(BOX, FrameClock((0.0, 1.0)), voxels=10**3)
    cameras = three_cameras()
    tracks = shifted_ball(cameras)
    start_from_tracks(field, 1, tracks, cameras, steps=200)
    moved = field.unwarp(tracks.canonical, 1.0)
    # The shift is more than the ball's radius: no rendered overlap could have shown it.
    assert (moved - tracks.canonical - SHIFT).norm(dim=1).mean() < 0.02
    back = field.warp(tracks.canonical + SHIFT, 1.0)
    assert (back - tracks.canonical).norm(dim=1).mean() < 0.03


def test_steps_of_a_fit_can_be_replayed_and_give_the_same() -> None:
    cameras, fields, done = three_cameras(), [], []

    class Replaying:
        """Runs the work again, as a graph does: on the same memory."""

        def warm_up(self, work: Work) -> None:
            done.append("warm")
            work()

        def capture(self, work: Work) -> Any:
            done.append("captured")
            return SimpleNamespace(replay=work)

    capturer: Any = Replaying()
    for each in (None, capturer):
        fields.append(DeformationField(BOX, FrameClock((0.0, 1.0)), voxels=6**3))
        start_from_tracks(fields[-1], 1, shifted_ball(cameras), cameras, steps=20, capturer=each)
    assert done == ["warm", "warm", "warm", "captured"] * 2
    for name in ("to_canonical", "to_time"):
        found, expected = (getattr(field, name) for field in fields[::-1])
        assert expected.abs().amax() > 0.05
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_wrong_flow_of_a_few_pixels_is_outvoted() -> None:
    field = DeformationField(BOX, FrameClock((0.0, 1.0)), voxels=6**3)
    cameras = three_cameras()
    tracks = shifted_ball(cameras)
    tracks.pixel[::20] += 40.0
    start_from_tracks(field, 1, tracks, cameras, steps=200)
    moved = field.unwarp(tracks.canonical, 1.0)
    assert (moved - tracks.canonical - SHIFT).norm(dim=1).median() < 0.05


def test_without_tracks_the_frame_stays_where_the_one_before_is() -> None:
    field = DeformationField(BOX, FrameClock((0.0, 0.5, 1.0)), voxels=4**3)
    field.to_canonical[1] = 0.25
    field.frames.copy_previous(2)
    nothing = Tracks(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2))
    start_from_tracks(field, 2, nothing, three_cameras())
    assert torch.equal(field.to_canonical[2], field.to_canonical[1])


def test_other_frames_are_not_touched() -> None:
    field = DeformationField(BOX, FrameClock((0.0, 0.5, 1.0)), voxels=6**3)
    cameras = three_cameras()
    start_from_tracks(field, 2, shifted_ball(cameras), cameras, steps=5)
    assert not field.to_canonical[:2].any() and not field.to_time[:2].any()
    assert field.to_canonical[2].any() and field.to_time[2].any()

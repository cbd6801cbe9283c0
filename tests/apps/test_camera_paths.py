"""Paths of a video's cameras: they stay where captured cameras were."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.apps.camera_paths import (
    bullet_time,
    captured,
    orbit,
    sector,
    spiral,
    swing,
    time_freeze,
    tour,
    upward,
)
from devrf.apps.video import VideoSettings
from devrf.geometry.cameras import Cameras

ORIGIN = torch.zeros(3)


def looking_in(azimuths, elevations, distance=2.0):
    """Cameras that look at the origin, angles in degrees, z up."""
    east, up = torch.deg2rad(torch.as_tensor(azimuths)), torch.deg2rad(torch.as_tensor(elevations))
    flat = torch.stack([east.cos() * up.cos(), east.sin() * up.cos(), up.sin()], dim=1)
    positions = distance * flat
    return Cameras.looking_at(positions, 0 * positions, focal=20.0, width=15, height=10)


def azimuths(cameras):
    return torch.rad2deg(torch.atan2(cameras.positions[:, 1], cameras.positions[:, 0]))


FOUR = looking_in([0.0, 90.0, 180.0, 270.0], [20.0] * 4)
# A walk on one side of the scene, looking down at it.
WALK = looking_in(torch.linspace(40, 120, 33), 30 + 2 * torch.arange(33.0).sin())


def test_an_orbit_of_cameras_all_around_is_a_full_turn_at_their_distance():
    settings = VideoSettings(frames=8, orbit_turns=2.0, orbit_elevation=30.0)
    cameras = orbit(FOUR, ORIGIN, settings)
    assert len(cameras) == 8 and (cameras.width, cameras.height) == (15, 10)
    torch.testing.assert_close(cameras.positions.norm(dim=1), torch.full((8,), 2.0))
    torch.testing.assert_close(cameras.positions[:, 2], torch.full((8,), 1.0))
    # Two turns in eight pictures: a quarter turn each.
    steps = cameras.positions[:-1, :2] * cameras.positions[1:, :2]
    torch.testing.assert_close(steps.sum(dim=1), torch.zeros(7), atol=1e-5, rtol=0)
    torch.testing.assert_close(cameras.forwards, -cameras.positions / 2)


def test_an_orbit_swings_within_the_sector_that_was_seen():
    cameras = orbit(WALK, ORIGIN, VideoSettings(frames=40))
    angles = azimuths(cameras)
    assert float(angles.min()) == pytest.approx(40, abs=1)
    assert float(angles.max()) == pytest.approx(120, abs=1)
    # From the middle to one end, to the other, and back: every place twice, no jump at the seam.
    torch.testing.assert_close(angles[:20] + angles[20:], torch.full((20,), 160.0), atol=3, rtol=0)
    # As high as the cameras, with a level horizon.
    heights = torch.rad2deg(torch.asin(cameras.positions[:, 2] / 2))
    torch.testing.assert_close(heights, torch.full((40,), 30.0), atol=3, rtol=0)
    assert float(upward(WALK)[2]) > 0.997


@pytest.mark.parametrize("elevation", [-90.0, -88.0, 0.0, 45.0, 88.5, 90.0])
def test_an_orbit_turns_evenly_at_any_height(elevation):
    settings = VideoSettings(frames=12, orbit_elevation=elevation)
    right = orbit(FOUR, ORIGIN, settings).camera_to_world[:, :, 0]
    torch.testing.assert_close(right[:, 2], torch.zeros(12), atol=1e-5, rtol=0)
    cosines = (right * right.roll(-1, dims=0)).sum(dim=1)
    torch.testing.assert_close(cosines, torch.full((12,), math.cos(math.pi / 6)))


@pytest.mark.parametrize(
    ("degrees", "seen"), [([10], 0), ([10, 110], 100), ([10, 190], 360), ([0, 120, 240], 360)]
)
def test_few_cameras_stand_all_around_if_no_half_circle_lacks_one(degrees, seen):
    _, extent = sector(torch.tensor(degrees).deg2rad())
    assert math.degrees(extent) == pytest.approx(seen, abs=1e-3)


@pytest.mark.parametrize("shuffled", [False, True])
def test_the_captured_path_follows_the_cameras_smoothly_in_any_order(shuffled):
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(33, generator=generator).tolist() if shuffled else list(range(33))
    cameras = captured(WALK[order], ORIGIN, VideoSettings(frames=48))
    angles = azimuths(cameras)
    turned = angles.diff() * (angles[-1] - angles[0]).sign()
    assert float((angles[-1] - angles[0]).abs()) > 60 and float(turned.min()) > 0
    assert 38 < float(angles.min()) and float(angles.max()) < 122
    steps = cameras.positions.diff(dim=0).norm(dim=1)
    assert float(steps.max() / steps.min()) < 1.2
    # They look at what was looked at, and their own jolts are gone.
    toward = torch.nn.functional.normalize(-cameras.positions, dim=1)
    assert float((cameras.forwards * toward).sum(dim=1).min()) > 0.995
    assert float(cameras.positions[:, 2].diff(n=2, dim=0).abs().max()) < 0.01
    rotations = cameras.camera_to_world[:, :, :3]
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(48))


@pytest.mark.parametrize("frames", [48, 240])
def test_between_cameras_far_apart_the_captured_path_shows_what_they_looked_at(frames):
    turns = 137.5 * torch.arange(16.0)  # evenly over the upper half of a sphere
    around = looking_in(turns % 360, torch.rad2deg(torch.asin((torch.arange(16) + 0.5) / 16)))
    # Half a turn apart, the mean of two positions is the target itself.
    for cameras in (FOUR, around, FOUR[[0, 2]]):
        path = captured(cameras, ORIGIN, VideoSettings(frames=frames))
        away = path.positions.norm(dim=1)
        torch.testing.assert_close(away, torch.full((frames,), 2.0), atol=1e-3, rtol=0)
        torch.testing.assert_close(path.forwards, -path.positions / 2, atol=1e-3, rtol=0)
        up = path.camera_to_world[:, :, 1]
        assert float((up[1:] * up[:-1]).sum(dim=1).min()) > math.cos(math.radians(400 / frames))


def test_the_captured_path_is_straight_between_cameras_that_look_the_same_way():
    places = torch.tensor([[-2.0, -3, 0], [0.5, -3, 0], [2, -3, 0]])
    walk = Cameras.looking_at(
        places, places + torch.tensor([0.0, 1, 0]), focal=20.0, width=15, height=10
    )
    path = captured(walk, ORIGIN, VideoSettings(frames=24))
    torch.testing.assert_close(path.positions[:, 1:], places[:1, 1:].expand(24, 2))
    torch.testing.assert_close(path.forwards, walk.forwards[:1].expand(24, 3))


def test_a_captured_path_past_the_pole_turns_evenly():
    angle = torch.deg2rad(torch.linspace(30, 150, 25))
    positions = torch.stack([angle.cos(), 0 * angle, angle.sin()], dim=1)
    over = Cameras.looking_at(positions, 0 * positions, focal=20.0, width=15, height=10)
    cameras = captured(over, ORIGIN, VideoSettings(frames=30))
    turns = cameras.camera_to_world[:, :, :3]
    trace = (turns[1:] * turns[:-1]).sum(dim=(1, 2))
    degrees = torch.rad2deg(torch.acos((trace - 1) / 2))
    assert degrees.max() < 1.5 * degrees.mean()


def test_a_tour_is_shorter_than_always_going_to_the_nearest():
    places = torch.tensor([[2.0, 1], [0, 0], [4, 0], [1, 1], [1, 0], [3, 2]])
    # From (4, 0) the nearest are (2, 1), (1, 1), (1, 0), (0, 0); then all the way to (3, 2).
    assert tour(torch.cdist(places, places).numpy()) == [1, 4, 3, 0, 5, 2]


def test_a_spiral_stays_among_cameras_that_look_the_same_way():
    cameras = spiral(looking_in([-8.0, 0, 8, 180], [0.0, 4, 0, 0]), ORIGIN, VideoSettings(frames=9))
    assert float(azimuths(cameras).abs().max()) < 8
    away = cameras.positions.norm(dim=1)
    torch.testing.assert_close(away, torch.full((9,), 2.0), atol=0.05, rtol=0)


def circle(settings):
    return orbit(FOUR, ORIGIN, settings)


def test_in_a_time_freeze_time_runs_then_the_camera_then_time():
    cameras, times = time_freeze(circle, 0.5, VideoSettings(frames=9))
    assert times == pytest.approx([0, 1 / 6, 1 / 3, 0.5, 0.5, 0.5, 0.5, 0.75, 1])
    around = circle(VideoSettings(frames=3)).positions
    torch.testing.assert_close(cameras.positions[:3], around[:1].expand(3, 3))
    torch.testing.assert_close(cameras.positions[3:6], around)
    torch.testing.assert_close(cameras.positions[6:], around[2:].expand(3, 3))
    # The shortest film, too, shows the end.
    assert time_freeze(circle, 0.5, VideoSettings(frames=5))[1] == [0, 0.5, 0.5, 0.5, 1]
    # In bullet time the camera alone moves.
    cameras, times = bullet_time(circle, 0.3, VideoSettings(frames=3))
    assert times == [0.3] * 3
    torch.testing.assert_close(cameras.positions, around)


def test_a_swing_is_where_the_camera_was_then_to_and_fro_while_time_stands_still():
    order = torch.randperm(33, generator=torch.Generator().manual_seed(0))
    settings = VideoSettings(frames=60, fps=10, time=0.25)
    cameras, times = swing(WALK[order], (order / 32).tolist(), settings)
    assert times[:20] == pytest.approx([0.0125 * k for k in range(20)])
    assert times[20:40] == [0.25] * 20 and times[40] == 0.25 and times[-1] == 1.0
    angles = azimuths(cameras)
    # The walk goes from 40 to 120 degrees at an even pace; smoothing keeps off its ends alone.
    torch.testing.assert_close(angles[10:20], 40 + 80 * torch.tensor(times[10:20]), atol=1, rtol=0)
    to_and_fro = angles[20:40] - 60
    assert float(to_and_fro.max()) == pytest.approx(80 * 0.06, abs=0.3)
    torch.testing.assert_close(to_and_fro, -to_and_fro.flip(0), atol=0.2, rtol=0)
    # Level and rigid: it shakes up and down by two degrees, the film hardly does.
    heights = torch.rad2deg(torch.asin(cameras.positions[:, 2] / cameras.positions.norm(dim=1)))
    assert float(heights.std()) < 0.5 * float((2 * torch.arange(33.0).sin()).std())
    turns = cameras.camera_to_world[:, :, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(60, 3, 3), atol=1e-5, rtol=0)

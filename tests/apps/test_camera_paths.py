"""Films in which time stands still."""

from __future__ import annotations

import pytest
import torch

from devrf.apps.video import VideoSettings, bullet_time, orbit, time_freeze
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras

CAMERAS = Cameras.looking_at(
    torch.tensor([[3.0, 0, 1], [0, 3, 1]]), torch.zeros(2, 3), focal=20, width=24, height=18
)


def ring(settings: VideoSettings) -> Cameras:
    return orbit(CAMERAS, Box((-1.0, -1, -1), (1.0, 1, 1)), settings)


def test_in_bullet_time_the_camera_alone_moves():
    cameras, times = bullet_time(ring, 0.3, VideoSettings(frames=8))
    assert times == [0.3] * 8
    torch.testing.assert_close(cameras.positions, ring(VideoSettings(frames=8)).positions)


def test_in_a_time_freeze_time_runs_then_the_camera_then_time():
    cameras, times = time_freeze(ring, 0.5, VideoSettings(frames=9))
    assert times == pytest.approx([0, 1 / 6, 1 / 3, 0.5, 0.5, 0.5, 0.5, 0.75, 1])
    start, around = cameras.positions[0], ring(VideoSettings(frames=3)).positions
    for k in (1, 2, 6, 7, 8):
        torch.testing.assert_close(cameras.positions[k], start)
    torch.testing.assert_close(cameras.positions[3:6], around)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 100])
def test_as_many_cameras_as_times_and_frames(frames):
    for film in (bullet_time, time_freeze):
        cameras, times = film(ring, 0.5, VideoSettings(frames=frames))
        assert len(cameras) == len(times) == frames


def test_time_stops_within_the_recording():
    with pytest.raises(DevrfError, match=r"video.time: expected 0 to 1, not 1.5"):
        VideoSettings(time=1.5)

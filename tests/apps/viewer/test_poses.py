"""Cameras on their way to the browser and back."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.apps.viewer.cameras import Pose
from devrf.apps.viewer.paths import distance_ahead
from devrf.geometry.cameras import Cameras


def test_a_camera_without_rotation_in_opencvs_axes():
    # OpenCV's camera that looks along z with y down is OpenGL's turned about x by half a turn.
    pose = Pose((1.0, 0, 0, 0), (1.0, 2, 3), math.radians(90), 1.5)
    expected = [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3]]
    assert pose.camera_to_world.tolist() == expected
    camera = pose.camera(100)
    assert (camera.width, camera.height) == (150, 100)
    assert camera.focal.tolist() == [[pytest.approx(50.0)] * 2]
    assert camera.forwards.tolist() == [[0, 0, 1]]


def test_there_and_back():
    cameras = Cameras.looking_at(
        torch.randn(5, 3) * 3, torch.randn(5, 3), focal=31.0, width=40, height=30
    )
    for k in range(5):
        camera = Pose.of_cameras(cameras, k).camera(30)
        torch.testing.assert_close(camera.camera_to_world[0], cameras.camera_to_world[k])
        torch.testing.assert_close(camera.focal[0], cameras.focal[k])
        assert (camera.width, camera.height) == (40, 30)


def test_where_cameras_look():
    places = torch.tensor([[3.0, 0, 0], [0, 3, 0], [0, 0, 3.0]])
    around = Cameras.looking_at(places, torch.zeros(3, 3), focal=1, width=2, height=2)
    assert distance_ahead(around) == pytest.approx(3.0, abs=1e-4)
    same_way = Cameras.looking_at(places, places - 1, focal=1, width=2, height=2)
    assert distance_ahead(same_way) == pytest.approx(6**0.5, abs=1e-4)  # of the mean to each

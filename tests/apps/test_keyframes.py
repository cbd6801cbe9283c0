"""A path goes smoothly through its keyframes; the scene's time goes straight."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.apps.keyframes import CameraPath, Keyframe, cameras_of, hermite, keyframes_of
from devrf.errors import DevrfError


def keyframe(seconds: float, x: float = 0.0, turn: float = 0.0, fov: float = 60.0, time: float = 0):
    """A camera at (x, 0, 0), turned about the vertical axis by ``turn`` degrees."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    pose = torch.tensor([[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 0]], dtype=torch.float32)
    return Keyframe(pose, fov, time, seconds)


def at(path: CameraPath, *moments: float) -> list[Keyframe]:
    return path.at(torch.tensor(moments, dtype=torch.float64))


def test_a_spline_by_hand():
    # Slopes 1, 0, -1: between 0 and 1 it is u + u² - u³.
    knots, values = torch.tensor([0.0, 1.0, 2.0]), torch.tensor([[0.0], [1.0], [0.0]])
    found = hermite(knots, values, torch.tensor([0.0, 0.5, 1.0, 1.5, 2.0]))
    assert found[:, 0].tolist() == [0.0, 0.625, 1.0, 0.625, 0.0]


def test_even_steps_on_a_line_stay_even():
    path = CameraPath(tuple(keyframe(k, x=3.0 * k) for k in range(4)), 1.0, 10)
    places = [float(one.camera_to_world[0, 3]) for one in at(path, 0, 0.5, 1.25, 3)]
    assert places == pytest.approx([0, 1.5, 3.75, 9])


def test_keyframes_at_uneven_moments_are_met():
    frames = (
        keyframe(0, 0, 0, 40, 0.0),
        keyframe(0.5, 2, 100, 50, 0.3),
        keyframe(4, 1, 200, 60, 0.9),
    )
    for found, given in zip(at(CameraPath(frames, 1, 10), 0, 0.5, 4), frames, strict=True):
        torch.testing.assert_close(found.camera_to_world, given.camera_to_world)
        assert (found.fov, found.time) == pytest.approx((given.fov, given.time))


def test_half_of_a_quarter_turn():
    (found,) = at(CameraPath((keyframe(0), keyframe(1, turn=90)), 1, 10), 0.5)
    expected = keyframe(0, turn=45).camera_to_world
    torch.testing.assert_close(found.camera_to_world, expected)


def test_a_whole_turn_goes_one_way():
    # A quaternion and its negative are one rotation: the signs have to follow one another.
    path = CameraPath(tuple(keyframe(k, turn=60 * k) for k in range(7)), 1, 10)
    for moment in (1.5, 3.5, 5.5):
        (found,) = at(path, moment)
        expected = keyframe(0, turn=60 * moment).camera_to_world
        torch.testing.assert_close(found.camera_to_world, expected, atol=0.02, rtol=0)


def test_time_stands_still_between_keyframes_of_one_time():
    path = CameraPath((keyframe(0), keyframe(1, time=0.5), keyframe(3, time=0.5)), 1, 10)
    assert [one.time for one in at(path, 0.5, 1, 2, 3)] == pytest.approx([0.25, 0.5, 0.5, 0.5])


def test_a_path_has_both_its_ends():
    path = CameraPath((keyframe(1), keyframe(3, x=1.0)), 1.5, 10)
    assert (path.duration, path.frames) == (2, 21)
    assert [one.seconds for one in path.sampled(3)] == [1, 2, 3]
    with pytest.raises(DevrfError, match="expected at most 90000 frames"):
        _ = CameraPath((keyframe(0), keyframe(1e7)), 1, 10).frames


def test_cameras_see_the_angle():
    cameras = cameras_of([keyframe(0, fov=90.0)], aspect=2.0, height=100)
    assert (cameras.width, cameras.height, cameras.center.tolist()) == (200, 100, [[100, 50]])
    assert cameras.focal.tolist() == [[pytest.approx(50.0)] * 2]
    (back,) = keyframes_of(cameras, [0.3], 7.0)
    assert (back.fov, back.time, back.seconds) == (pytest.approx(90.0), 0.3, 0.0)

"""How time runs on the page: at speed 1 all of it in five seconds."""

from __future__ import annotations

import pytest

from devrf.apps.viewer.controls import Playback


def test_time_stands_until_it_is_played():
    assert Playback(time=0.3).advanced(10) == Playback(time=0.3)


@pytest.mark.parametrize(("speed", "time"), [(1, 0.4), (0.5, 0.3), (4, 1.0)])
def test_speed(speed, time):
    later = Playback(time=0.2, playing=True, speed=speed).advanced(1)
    assert later.time == pytest.approx(time) and later.playing


def test_a_loop_begins_anew_and_another_stops_at_the_end():
    assert Playback(time=0.9, playing=True).advanced(1).time == pytest.approx(0.1)
    ended = Playback(time=0.9, playing=True, loop=False).advanced(1)
    assert (ended.time, ended.playing) == (1.0, False)
    assert ended.started() == Playback(time=0.0, playing=True, loop=False)

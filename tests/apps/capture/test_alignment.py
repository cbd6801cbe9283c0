"""Videos of one motion are aligned by it, whatever their rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devrf.apps.capture.alignment import offset_between, timeline
from devrf.errors import DevrfError

PATHS = [Path("a.mp4"), Path("b.mp4")]


def bursts(seed=0):
    """Motion that starts and stops irregularly, over ten seconds."""
    generator = np.random.default_rng(seed)
    moments, heights = generator.uniform(0, 10, 12), generator.uniform(1, 5, 12)

    def motion(times):
        return sum(
            h * np.exp(-((times - m) ** 2) / 0.08) for m, h in zip(moments, heights, strict=True)
        )

    return motion


@pytest.mark.parametrize("offset", [-1.3, 0.0, 0.77])
@pytest.mark.parametrize("rate", [30, 24])
def test_the_offset_is_found_within_a_quarter_of_a_frame(surveyed, offset, rate):
    first = surveyed(bursts(), 30, 8, begin=1.5)
    second = surveyed(bursts(), rate, 7, begin=1.5 + offset)
    found, correlation = offset_between(first, second)
    assert found == pytest.approx(offset, abs=0.25 / rate)
    assert correlation > 0.95


def test_moments_are_those_of_the_slower_video_in_the_common_part(surveyed):
    surveys = [surveyed(bursts(), 30, 6), surveyed(bursts(), 15, 6, begin=1.0)]
    clock = timeline(PATHS, surveys, 50, offsets=[0, 1])
    # 1.0 s to the first video's last frame at 179/30 s: 75 frames of the second, every other one.
    assert clock.positions[1] == tuple(range(0, 75, 2))
    assert clock.positions[0] == tuple(range(30, 180, 4))
    assert clock.times[0] == 0 and clock.times[-1] == 1
    assert np.allclose(np.diff(clock.times), 1 / 37)
    assert clock.of(clock.plain()) == clock


def test_what_cannot_be_aligned_is_refused(surveyed):
    one, still = surveyed(bursts(), 30, 8), surveyed(np.zeros_like, 30, 8)
    with pytest.raises(DevrfError, match=r"b\.mp4: nothing moves in it; give capture\.offsets="):
        timeline(PATHS, [one, still], 10)
    noise = surveyed(lambda t: np.random.default_rng(5).uniform(0, 1, len(t)), 30, 8)
    with pytest.raises(DevrfError, match=r"b\.mp4: what moves in it does not tell when it began"):
        timeline(PATHS, [one, noise], 10)
    with pytest.raises(DevrfError, match=r"b\.mp4: all 2 videos together show 2\.97 s, of 7\.97"):
        timeline(PATHS, [one, one], 10, offsets=[0, 5])

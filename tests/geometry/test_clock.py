"""The frame clock: times become frames and weights."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.clock import BetweenFrames, FrameClock

UNEVEN = FrameClock((0.0, 0.1, 0.5, 1.0))


@pytest.mark.parametrize(
    ("time", "before", "after", "weight"),
    [
        (0.0, 0, 0, 0.0),
        (0.1, 1, 1, 0.0),
        (0.2, 1, 2, 0.25),
        (0.625, 2, 3, 0.25),
        (-0.3, 0, 0, 0.0),
        (1.7, 3, 3, 0.0),
    ],
)
def test_moments_of_an_uneven_clock(time, before, after, weight):
    moment = UNEVEN.at(time)
    assert (moment.before, moment.after) == (before, after)
    assert moment.weight == pytest.approx(weight)


@pytest.mark.parametrize("frames", [3, 100])
def test_every_frame_is_found_exactly_in_spite_of_float32(frames):
    times = torch.arange(frames) / (frames - 1)
    clock = FrameClock(tuple(k / (frames - 1) for k in range(frames)))
    for k, time in enumerate(times.tolist()):
        assert clock.at(time) == BetweenFrames(k, k, 0.0)
    assert clock.frames_of(times).tolist() == list(range(frames))
    assert FrameClock.from_times(times.double()).times == pytest.approx(clock.times, abs=1e-6)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([[1.0, 0.5, 0.25], [0.5 + 1e-7, 0.25, 1.0]], (0.0, 0.25, 0.5, 1.0)),
        # A capture that starts late does not start at rest.
        ([0.2, 0.6], (0.0, 0.2, 0.6)),
    ],
)
def test_from_times_sorts_merges_roundings_and_puts_rest_before(times, expected):
    assert FrameClock.from_times(torch.tensor(times)).times == pytest.approx(expected)


def test_frames_of_gives_the_nearest_frame_in_any_shape():
    times = torch.tensor([[0.04, 0.06, 0.29], [0.31, 0.9, 0.7]])
    assert UNEVEN.frames_of(times).tolist() == [[0, 1, 1], [2, 3, 2]]
    assert UNEVEN.frames_of(times).dtype == torch.int64
    assert UNEVEN.frames_of(torch.tensor([-0.1, 1.7])).tolist() == [0, len(UNEVEN) - 1]


def test_a_clock_without_rest_or_out_of_order_is_an_error():
    for times in ((0.1, 0.2), (0.0, 0.6, 0.5)):
        with pytest.raises(ValueError, match="frame clock"):
            FrameClock(times)


def test_a_clock_knows_the_times_of_its_frames_up_to_rounding():
    clock = FrameClock((0.0, 1 / 3, 0.8))
    known = (0.0, float(torch.tensor(1 / 3)), 0.333333, 0.8)
    assert all(clock.knows(time) for time in known)
    assert not any(clock.knows(time) for time in (0.3, 0.34, 0.9, 1.0))


def test_many_times_lie_where_each_of_them_does():
    clock = FrameClock((0.0, 0.4, 1.0))
    times = torch.tensor([-0.1, 0.0, 0.1, 0.4, 0.7, 1.0, 1.2])
    before, after, weight = clock.between(times)
    alone = [clock.at(time) for time in times.tolist()]
    assert before.tolist() == [one.before for one in alone]
    assert after.tolist() == [one.after for one in alone]
    torch.testing.assert_close(weight, torch.tensor([one.weight for one in alone]))

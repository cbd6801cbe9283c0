"""Progress of long work: lines with the time that is left."""

from __future__ import annotations

import logging

import pytest

from devrf.system.progress import followed, time_left


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.2, "about 1 s left"),
        (42.4, "about 42 s left"),
        (100, "about 2 min left"),
        (3570, "about 60 min left"),
        (4000, "about 1 h 7 min left"),
        (7200, "about 2 h left"),
        (50_000, "about 14 h left"),
    ],
)
def test_no_more_digits_than_mean_something(seconds: float, said: str) -> None:
    assert time_left(seconds) == said


def test_work_is_followed_in_lines_where_there_is_no_terminal(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, logger="devrf")
    assert list(followed(iter("abc"), 3, "film", line_every_seconds=0.0)) == ["a", "b", "c"]
    assert [line.split(", ")[0] for line in caplog.messages] == ["film: 1 of 3", "film: 2 of 3"]
    assert all(line.endswith("left") for line in caplog.messages)
    caplog.clear()
    assert list(followed(iter("abc"), 3, "film")) == ["a", "b", "c"] and not caplog.messages

"""What counts as gone wrong, by hand."""

from __future__ import annotations

import math

import pytest

from devrf.callbacks.divergence import emptied, filled, not_finite, stands_out


@pytest.mark.parametrize(
    ("seen", "most", "expected", "gone"),
    [
        (0.001, 0.2, 0.3, True),
        (0.02, 0.2, 0.3, False),  # faint, but there
        (0.001, 0.02, 0.3, False),  # it has never been there
        (0.0, 0.2, 0.01, False),  # nothing should be there
        (0.0, 0.2, 0.2, True),
    ],
)
def test_matter_that_was_there_and_should_be_is_missed(seen, most, expected, gone) -> None:
    assert emptied(seen, most, expected) is gone


@pytest.mark.parametrize(
    ("seen", "least", "expected", "full"),
    [
        (0.7, 0.2, 0.2, True),
        (0.5, 0.2, 0.2, False),  # three fifths of the light still pass
        (0.7, 0.5, 0.2, False),  # it never passed: fog, at the beginning
        (1.0, 0.1, 0.99, False),  # no light should pass
    ],
)
def test_light_that_passed_and_should_is_missed(seen, least, expected, full) -> None:
    assert filled(seen, least, expected) is full


def test_the_first_that_is_not_finite_is_named() -> None:
    assert not_finite({"loss": 1.0, "flow": 0.0}) is None
    assert not_finite({"loss": 1.0, "flow": math.inf, "cycle": math.nan}) == "flow"


def test_a_frame_is_compared_with_its_neighbours() -> None:
    even = [1.0, 1.1, 0.9, 1.0, 1.0]
    # Five deviations of a quarter: a factor of 3.5.
    assert stands_out(3.4, even) is None
    assert stands_out(4.0, even) == pytest.approx(4.0)
    assert stands_out(100.0, even[:3]) is None  # too few to tell
    # Losses that differ widely: 1.4826 deviations of log 3.
    wide = [1.0, 3.0, 9.0, 27.0, 81.0]
    assert stands_out(9.0 * 3**7, wide) is None
    assert stands_out(9.0 * 3**8, wide) == pytest.approx(3**8)
    # Little by little it may grow as far as it likes.
    assert stands_out(9.0, [1.0, 1.0, 1.1, 1.0, 5.0]) is None
    # What stood out itself does not widen the range, and what is long past does not count.
    assert stands_out(4.0, [1.0, 1.0, 50.0, 1.0, 1.0]) == pytest.approx(4.0)
    assert stands_out(4.0, [1.0] * 50 + [4.0] * 10) is None

"""What counts as divergence, by hand."""

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
    ],
)
def test_emptied(seen, most, expected, gone) -> None:
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
def test_filled(seen, least, expected, full) -> None:
    assert filled(seen, least, expected) is full


def test_the_first_value_that_is_not_finite_is_named() -> None:
    assert not_finite({"loss": 1.0, "flow": 0.0}) is None
    assert not_finite({"loss": 1.0, "flow": math.inf, "cycle": math.nan}) == "flow"


@pytest.mark.parametrize(
    ("loss", "others", "factor"),
    [
        # Five deviations of a quarter: a factor of 3.5.
        (3.4, [1.0, 1.1, 0.9, 1.0, 1.0], None),
        (4.0, [1.0, 1.1, 0.9, 1.0, 1.0], 4.0),
        (100.0, [1.0, 1.1, 0.9], None),  # too few to tell
        # Losses that differ widely: 1.4826 deviations of log 3.
        (9.0 * 3**7, [1.0, 3.0, 9.0, 27.0, 81.0], None),
        (9.0 * 3**8, [1.0, 3.0, 9.0, 27.0, 81.0], 3**8),
        (9.0, [1.0, 1.0, 1.1, 1.0, 5.0], None),  # less than twice the last
        (4.0, [1.0, 1.0, 50.0, 1.0, 1.0], 4.0),  # an outlier does not widen the range
        (4.0, [1.0] * 50 + [4.0] * 10, None),  # frames long past do not count
    ],
)
def test_an_outlier_among_losses(loss, others, factor) -> None:
    assert stands_out(loss, others) == (factor and pytest.approx(factor))

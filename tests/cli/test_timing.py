"""What is measured, and how thoroughly."""

from __future__ import annotations

from typing import Any

import pytest

from devrf.cli.timing import BenchmarkSettings, Spread
from devrf.errors import DevrfError


def test_a_spread_is_the_middle_and_the_ends() -> None:
    assert Spread.of([3.0, 1.0, 8.0]) == Spread(3.0, 1.0, 8.0)
    assert Spread.of([1.0, 2.0]) == Spread(1.5, 1.0, 2.0)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"warmup": -1}, "benchmark.warmup: expected at least 0, not -1"),
        ({"repeats": 0}, "benchmark.repeats: expected at least 1, not 0"),
        ({"views": 0}, "benchmark.views: expected at least 1, not 0"),
        ({"training": 0.0}, "benchmark.training: expected more than 0 and at most 1, not 0.0"),
        ({"training": 1.5}, "benchmark.training: expected more than 0 and at most 1, not 1.5"),
    ],
)
def test_settings_that_measure_nothing(given: dict[str, Any], expected: str) -> None:
    with pytest.raises(DevrfError) as caught:
        BenchmarkSettings(**given)
    assert str(caught.value) == expected

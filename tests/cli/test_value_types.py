"""Config values against the types of signatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union

import pytest

from devrf.cli.value_types import described, fits


@pytest.mark.parametrize(
    ("hint", "fitting", "unfit"),
    [
        (int, [3], ["3", 3.0, True, None]),
        (float, [3, 3.5], [True, "a"]),
        (str, ["a"], [3]),
        (Path, ["a/b"], [3]),
        (bool, [True], [1]),
        (type(None), [None], [0]),
        (Union[int, None], [None, 1], ["a"]),  # noqa: UP007 - the older spelling
        (float | str, ["auto", 0.5], [None]),
        (Literal["one", "all"], ["one"], ["both"]),
        (Sequence[int], [[1, 2]], [[1, "a"], 1]),
        (Sequence[str], [["ab"]], ["ab"]),
        (Sequence[Sequence[float]], [[[0.0, 1]]], [[0.0]]),
        (Mapping[str, float], [{"color": 1}], [{"color": "high"}]),
        (Any, ["anything"], []),
        (Exception, ["x"], []),  # no config value has the type
    ],
)
def test_fits(hint, fitting, unfit):
    assert [fits(value, hint) for value in fitting] == [True] * len(fitting)
    assert [fits(value, hint) for value in unfit] == [False] * len(unfit)


def test_types_in_words():
    assert described(int | None) == "a whole number or null"
    assert described(Literal["one", "all"]) == "one of one, all"
    assert described(Sequence[int]) == "a list of which each is a whole number"

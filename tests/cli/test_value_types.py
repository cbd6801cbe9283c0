"""Types of config values, told from signatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union

import pytest

from devrf.cli.value_types import described, fits

FITTING = [
    (3, int),
    (3, float),
    (3.5, float),
    ("a", str),
    ("a/b", Path),
    (True, bool),
    (None, None),
    (None, int | None),
    ("a", str | Path),
    ("auto", float | str),
    (None, Union[int, None]),  # noqa: UP007 - the older spelling
    ("one", Literal["one", "all"]),
    ([1, 2], Sequence[int]),
    ([[0.0, 1]], Sequence[Sequence[float]]),
    ({"color": 1}, Mapping[str, float]),
    ("anything", Any),
    ("x", Exception),
]
UNFIT = [
    ("3", int),
    (3.0, int),
    (True, int),
    (True, float),
    (3, str),
    (None, int),
    (1, bool),
    ("both", Literal["one", "all"]),
    ([1, "a"], Sequence[int]),
    (1, Sequence[int]),
    ("ab", Sequence[str]),
    ({"color": "high"}, Mapping[str, float]),
    ("a", float | None),
]


@pytest.mark.parametrize(("value", "hint"), FITTING)
def test_fits(value, hint):
    assert fits(value, type(None) if hint is None else hint)


@pytest.mark.parametrize(("value", "hint"), UNFIT)
def test_does_not_fit(value, hint):
    assert not fits(value, hint)


def test_types_in_words():
    assert described(int | None) == "a whole number or null"
    assert described(Literal["one", "all"]) == "one of one, all"
    assert described(Sequence[int]) == "a list of which each is a whole number"

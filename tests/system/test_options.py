"""Settings that check themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import pytest
from annotated_types import Ge, Lt, MinLen
from pydantic.dataclasses import dataclass

from devrf.errors import DevrfError
from devrf.system.options import Count, Options, expectation


@dataclass(frozen=True)
class Some(Options):
    key: ClassVar[str] = "part.some"

    rays: Count
    opacity: Annotated[float, Ge(0), Lt(1)] = 0.5
    sides: Annotated[Sequence[Count], MinLen(1)] = (1, 2)
    kind: Literal["one", "other"] = "one"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Some(0), "part.some.rays: expected at least 1, not 0; correct it"),
        (lambda: Some(rays=1, opacity=1), "part.some.opacity: expected below 1, not 1; correct it"),
        (lambda: Some(1, math.nan), "part.some.opacity: expected below 1, not nan; correct it"),
        (lambda: Some(1, sides=()), "part.some.sides: expected at least 1 item, not 0; correct it"),
        (lambda: Some(1, sides=[3, 0]), "part.some.sides[1]: expected at least 1, not 0; correct"),
        (lambda: Some(1, kind="neither"), "part.some.kind: expected 'one' or 'other', not 'neith"),
        (lambda: Some(), "part.some.rays: is missing; add it"),
        (lambda: Some(1, ray=2), "part.some.ray: no such option; correct its name"),
        (lambda: replace(Some(1), rays=-1), "part.some.rays: expected at least 1, not -1"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make: Callable[[], Some], said: str) -> None:
    with pytest.raises(DevrfError) as refusal:
        make()
    assert str(refusal.value).startswith(said) and "\n" not in str(refusal.value)


def test_values_that_can_be_are_kept() -> None:
    assert Some(3, sides=[4]) == Some(rays=3, opacity=0.5, sides=[4], kind="one")


def test_pydantic_speaks_as_the_project_does() -> None:
    assert expectation("Input should be greater than or equal to 2") == "at least 2"
    assert expectation("Input should be less than or equal to 1") == "at most 1"
    assert expectation("List should have at least 1 item after validation, not 0") == (
        "at least 1 item, not 0"
    )

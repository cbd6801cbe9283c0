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
from devrf.system.options import Count, Options, abbreviated, expectation


@dataclass(frozen=True)
class Some(Options):
    key: ClassVar[str] = "part.some"

    rays: Count
    opacity: Annotated[float, Ge(0), Lt(1)] = 0.5
    sides: Annotated[Sequence[Count], MinLen(1)] = (1, 2)
    kind: Literal["one", "other"] = "one"
    width: Count | Literal["auto"] = "auto"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Some(0), "part.some.rays: expected at least 1, not 0; correct it"),
        (lambda: Some(rays=1, opacity=1), "part.some.opacity: expected below 1, not 1; correct it"),
        (lambda: Some(1, math.nan), "part.some.opacity: expected below 1, not nan; correct it"),
        (lambda: Some(1, sides=()), "part.some.sides: expected at least 1 item, not 0; correct it"),
        (lambda: Some(1, sides=[3, 0]), "part.some.sides[1]: expected at least 1, not 0; correct"),
        (lambda: Some(1, kind="neither"), "part.some.kind: expected 'one' or 'other', not 'neith"),
        (lambda: Some(1, width=0), "part.some.width: expected at least 1 or 'auto', not 0"),
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


def test_too_many_values_are_a_mistake_of_the_caller() -> None:
    with pytest.raises(TypeError, match="too many positional arguments"):
        Some(1, 0.5, (1,), "one", 5, 6)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="rays: given twice"):
        Some(1, rays=2)  # type: ignore[misc]


def test_pydantic_speaks_as_the_project_does() -> None:
    least = "Input should be greater than or equal to 2"
    assert expectation([least], "1") == "expected at least 2, not 1"
    either = [least, "Input should be 'auto'"]
    assert expectation(either, "'one'") == "expected at least 2 or 'auto', not 'one'"
    empty = "List should have at least 1 item after validation, not 0"
    assert expectation([empty], "[]") == "expected at least 1 item, not 0"
    assert expectation(["Odd input"], "3") == "odd input, not 3"


def test_a_value_is_shown_in_few_words() -> None:
    assert abbreviated([[[1]], 10**400]) == "[[[...]], a large number]"
    assert len(abbreviated("x" * 10**6)) <= 60

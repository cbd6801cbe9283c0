"""Settings that check themselves: what is wrong, where, and what to do, in one line."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated, Any, ClassVar

from annotated_types import Ge, Gt, Le
from pydantic import ConfigDict, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from devrf.errors import DevrfError

# Types of settings: how many, how many that make a grid or a series, shares, and factors.
Count = Annotated[int, Ge(1)]
Several = Annotated[int, Ge(2)]
Share = Annotated[float, Ge(0), Le(1)]
NotNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]

# A value can be of any length; a message has to be read.
LONGEST_MESSAGE = 480
LONGEST_VALUE = 60
# What pydantic says of a number, and what this project does.
WORDS = {
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "greater than": "more than",
    "less than": "below",
}

_brief = reprlib.Repr()
_brief.maxlevel = 2


def one_line(where: object, what: str) -> str:
    """``where: what`` in one line that is not too long."""
    return _shortened(" ".join(f"{where}: {what}".split()), LONGEST_MESSAGE)


def abbreviated(value: object) -> str:
    """A value as a message shows it: however large or deep, in a few words."""
    return _shortened(_brief.repr(value), LONGEST_VALUE)


def _shortened(text: str, most: int) -> str:
    """``text``, its middle left out where it is longer than ``most`` characters."""
    half = most // 2 - 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def first_error(error: ValidationError, where: str, arguments: Sequence[str] = ()) -> DevrfError:
    """The first thing that pydantic found wrong: key, expectation, and the value that was given.

    Args:
        error: what a model or an adapter raised.
        where: what comes before the key: ``FILE: `` for values in a file, ``data.`` for options.
        arguments: names of what may be given by its place.
    """
    first = error.errors(include_url=False)[0]
    loc = first["loc"]
    if arguments and isinstance(loc[0], int):
        loc = (arguments[loc[0]], *loc[1:])
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)
    place = f"{where}{key.removeprefix('.')}" if key else where.rstrip(": .")
    return DevrfError(one_line(place, _complaint(first)))


def _complaint(issue: Any) -> str:
    if issue["type"] == "json_invalid":
        return f"not valid JSON ({issue['ctx']['error']}); write it again"
    if issue["type"] == "missing":
        return "is missing; add it"
    if issue["type"] == "unexpected_keyword_argument":
        return "no such option; correct its name"
    if issue["type"] == "value_error":  # raised by a validator of ours
        return str(issue["ctx"]["error"])
    expected = expectation(issue["msg"])
    # For lists that are too short or too long, the message says the length itself.
    value = "" if ", not " in expected else f", not {abbreviated(issue['input'])}"
    return f"expected {expected}{value}; correct it"


def expectation(message: str) -> str:
    """What pydantic expects, as ``at least 1`` of "Input should be greater than or equal to 1"."""
    message = re.sub(r"^\w+ should (be|have) ", "", message).replace(" after validation", "")
    return re.sub("|".join(WORDS), lambda found: WORDS[found[0]], message)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Settings, checked by their types when they are made; a wrong one is a DevrfError.

    Subclasses are pydantic's dataclasses, too.

    Attributes:
        key: where they are in a config.
    """

    key: ClassVar[str]

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_line(cls, value: Any, validate: Any) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            raise first_error(error, f"{cls.key}.", [field.name for field in fields(cls)]) from None

"""Settings that check themselves: an error names key, expectation and remedy in one line."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Sequence
from inspect import signature
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs

from devrf.errors import DevrfError
from devrf.system.printed import shown

# Types of settings: counts, counts of a grid or a series, shares, and factors.
Whole = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Several = Annotated[int, Field(strict=True, ge=2)]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
NotNegative = Annotated[float, Field(strict=True, ge=0)]
Positive = Annotated[float, Field(strict=True, gt=0)]

# A value can be of any length; a message has to be read.
LONGEST_MESSAGE = 480
LONGEST_VALUE = 60
# Pydantic's words for the range of a number, and this project's.
WORDS = {
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "greater than": "more than",
    "less than": "below",
}


class _Brief(reprlib.Repr):
    def repr_int(self, x: int, level: int) -> str:
        """A number, but for those that Python refuses to write in digits."""
        return super().repr_int(x, level) if x.bit_length() < 1024 else "a large number"


_brief = _Brief()
_brief.maxlevel = 2


def one_line(where: object, what: str, typed: str = "") -> str:
    """``where: what`` in one line that is not too long, then words to type, of any length."""
    said = _shortened(shown(" ".join(f"{where}: {what}".split())), LONGEST_MESSAGE)
    return f"{said} {typed}" if typed else said


def abbreviated(value: object) -> str:
    """A value as a message shows it: however large or deep, in a few words."""
    return _shortened(_brief.repr(value), LONGEST_VALUE)


def _shortened(text: str, most: int) -> str:
    """``text``, its middle left out where it is longer than ``most`` characters."""
    half = most // 2 - 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def first_error(error: ValidationError, where: str, *, in_file: bool = True) -> DevrfError:
    """The first of pydantic's errors in words: key, expectation, and the wrong value.

    Args:
        error: raised by a model or an adapter.
        where: text before the key: ``FILE: `` for values in a file, ``data.`` for options.
        in_file: whether the value is in a file; an option may have one of several types.
    """
    issues = error.errors(include_url=False)
    alike = issues[:1]
    loc = issues[0]["loc"]
    if not in_file:
        alike = [issue for issue in issues if issue["loc"][:1] == loc[:1]]
        # The other parts name types that pydantic tried.
        loc = (*loc[:1], *(part for part in loc[1:] if isinstance(part, int)))
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)
    key_path = f"{where}{key.removeprefix('.')}" if key else where.rstrip(": .")
    return DevrfError(one_line(key_path, _complaint(issues[0], [issue["msg"] for issue in alike])))


def _complaint(issue: Any, alike: Sequence[str]) -> str:
    if issue["type"] == "json_invalid":
        return f"not valid JSON ({issue['ctx']['error']}); write it again"
    if issue["type"] == "missing":
        return "is missing; add it"
    if issue["type"] == "unexpected_keyword_argument":
        return "no such option; correct its name"
    if issue["type"] == "value_error":  # raised by a validator of ours
        return str(issue["ctx"]["error"])
    return f"{expectation(alike, abbreviated(issue['input']))}; correct it"


def expectation(messages: Sequence[str], value: str) -> str:
    """``expected at least 1, not 0`` of "Input should be greater than or equal to 1" and 0.

    Several ``messages`` of pydantic name the alternatives.
    """
    said = " or ".join(dict.fromkeys(re.sub(r"^\w+ should (be|have) ", "", m) for m in messages))
    said = re.sub("|".join(WORDS), lambda match: WORDS[match[0]], said)
    said = said.replace(" after validation", "")
    said = f"expected {said}" if " should " in messages[0] else f"{said[0].lower()}{said[1:]}"
    # For lists that are too short or too long, the message says the length itself.
    return said if ", not " in said else f"{said}, not {value}"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Options:
    """Settings, checked by their types when they are made; a wrong one is a DevrfError.

    Subclasses are pydantic's dataclasses, too.

    Attributes:
        key: their group in a config.
    """

    key: ClassVar[str]

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_line(cls, value: Any, validate: Any) -> Any:
        if not isinstance(value, ArgsKwargs):
            return validate(value)  # a part of something larger, which knows the whole key
        given = signature(cls).bind_partial(*value.args).arguments
        named = value.kwargs or {}
        if twice := ", ".join(given.keys() & named):
            raise TypeError(f"{cls.__name__}: {twice}: given twice")
        try:
            return validate(ArgsKwargs((), given | named))
        except ValidationError as error:
            raise first_error(error, f"{cls.key}.", in_file=False) from None

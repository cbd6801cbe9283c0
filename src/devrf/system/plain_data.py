"""Plain data from a file becomes objects, its types checked as those of a configuration."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, TypeVar

from annotated_types import Ge, Gt, Le, Predicate
from pydantic import TypeAdapter

from devrf.system.printed import is_shown

Kind = TypeVar("Kind")
# How many; a factor; text that a terminal shows as it is.
Count = Annotated[int, Ge(0), Le(2**53)]
Share = Annotated[float, Gt(0), Le(1)]
Factor = Annotated[float, Gt(0), Le(1e6)]
Line = Annotated[str, Predicate(is_shown)]


def validate(kind: type[Kind], data: Any) -> Kind:
    """A ``kind`` (a dataclass, a TypedDict, a number) of ``data``.

    Raises:
        ValueError: an entry is missing, or has another type.
        DevrfError: the object itself refuses a value.
    """
    adapter: TypeAdapter[Kind] = _adapter(kind)  # type: ignore[arg-type]
    return adapter.validate_python(data)


_adapter = cache(TypeAdapter)

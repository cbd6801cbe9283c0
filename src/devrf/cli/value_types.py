"""Whether a config value has the type that a signature states, and that type in words."""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    Path: "a path",
    type(None): "null",
}


def fits(value: object, hint: Any) -> bool:
    """Whether ``value`` fits a parameter annotated ``hint``; True for types no config value has.

    Text counts as a path, a list as any sequence, a whole number as a number.
    """
    # Imported here: --help is answered before it has loaded.
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

    try:
        adapter = TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
        # As JSON: of Python objects, strictly, text would be no path and a list no tuple.
        adapter.validate_json(json.dumps(value, default=str), strict=True)
    except PydanticUserError:  # a hint that pydantic does not know
        return True
    except ValidationError as error:
        return any(one["type"] == "needs_python_object" for one in error.errors())
    return True


def choices(hint: Any) -> tuple[object, ...]:
    """The values that a hint enumerates; none where it does not."""
    inner = get_args(hint)
    if get_origin(hint) is Literal:
        return inner
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(value for one in inner for value in choices(one))
    return ()


def described(hint: Any) -> str:
    """The type in words: ``a whole number or null``."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(described(one) for one in inner))
    if origin is Literal:
        return f"one of {', '.join(str(one) for one in inner)}"
    if origin in (list, Sequence):
        return f"a list of which each is {described(inner[0])}"
    if origin in (dict, Mapping):
        return "a mapping"
    return WORDS.get(hint, getattr(hint, "__name__", str(hint)))

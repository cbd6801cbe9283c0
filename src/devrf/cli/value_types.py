"""Whether a value from a config is of the type that a signature states, and that type in words."""

from __future__ import annotations

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
    """Whether ``value`` can be given where ``hint`` is stated; True for types not known here."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin in (list, Sequence):
        return isinstance(value, list) and all(fits(v, inner[0]) for v in value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping) and all(fits(v, inner[1]) for v in value.values())
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (str, Path):
        return isinstance(value, str)
    if hint in (bool, type(None)):
        return isinstance(value, hint)
    return True


def described(hint: Any) -> str:
    """The type in the words of someone who writes a config: ``a whole number or null``."""
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


def held(hint: Any) -> Any:
    """The type of a mapping's values; None where ``hint`` is no mapping."""
    return get_args(hint)[1] if get_origin(hint) in (dict, Mapping) else None

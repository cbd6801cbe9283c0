"""Nested data as JSON, with its tensors apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor


def flatten(value: Any, tensors: dict[str, Tensor], name: str = "") -> Any:
    """``value`` as JSON, with objects for tensors, dicts, tuples and sets.

    Args:
        value: nested dicts, lists, tuples and sets of tensors, numbers, strings and None.
        tensors: gets the tensors in ``value``, each by its path from the outermost dict.
        name: the path of ``value``.

    Raises:
        TypeError: there is something else in it.
    """
    if isinstance(value, Tensor):
        while name in tensors:  # as with the keys 1 and "1"
            name += "'"
        tensors[name] = value.detach()
        return {"tensor": name}
    if isinstance(value, dict):
        pairs = value.items()
        return {"dict": [[flatten(k, {}), flatten(v, tensors, f"{name}/{k}")] for k, v in pairs]}
    if isinstance(value, list | tuple | set):
        items = [flatten(one, tensors, f"{name}/{k}") for k, one in enumerate(value)]
        kind = "tuple" if isinstance(value, tuple) else "set"
        return items if isinstance(value, list) else {kind: items}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{name}: a checkpoint cannot hold a {type(value).__name__}")


def unflatten(node: Any, tensors: Mapping[str, Any]) -> Any:
    """The nested data that :func:`flatten` made ``node`` and ``tensors`` of.

    Raises:
        LookupError, TypeError, ValueError: ``node`` is not of its making.
    """
    if isinstance(node, list):
        return [unflatten(one, tensors) for one in node]
    if not isinstance(node, dict):
        return node
    ((kind, value),) = node.items()
    if kind == "tensor":
        return tensors[value]
    if kind == "dict":
        return {unflatten(k, tensors): unflatten(v, tensors) for k, v in value}
    return {"tuple": tuple, "set": set}[kind](unflatten(one, tensors) for one in value)

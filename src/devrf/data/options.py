"""Datamodules take the options of what makes their scene: declared and documented once, there."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, get_type_hints

P = ParamSpec("P")
Init = Callable[Concatenate[Any, P], None]


def takes_options_of(source: Callable[P, object]) -> Callable[[Callable[..., None]], Init[P]]:
    """Give an ``__init__`` that passes all it gets on to ``source`` the signature of ``source``.

    Type checkers, :func:`inspect.signature` and :func:`typing.get_type_hints` then know its
    options by name, type and default.

    Args:
        source: a dataclass.
    """

    def decorate(init: Callable[..., None]) -> Init[P]:
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        options = inspect.signature(source).parameters.values()
        init.__signature__ = inspect.Signature([own, *options])  # type: ignore[attr-defined]
        init.__annotations__ = get_type_hints(source)
        return init

    return decorate

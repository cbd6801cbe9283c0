"""Classes that a checkpoint may name: devrf's own, and those of installed plug-ins.

A file names a class by its path. That path is looked up among the classes that inherit
:class:`StoredClass`; nothing else can be reached through it, and only modules of methods are
imported for it: those below ``devrf.methods``, and those that an installed package declares as
entry points of the group ``devrf.methods``.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, ClassVar, TypeVar

METHODS = "devrf.methods"

Kind = TypeVar("Kind")
_known: dict[str, type[Any]] = {}


class StoredClass:
    """A class whose modules a checkpoint may hold: each subclass is known by its path.

    Attributes:
        unbuilt: names of settings that no layer or grid is built by: they may be large numbers.
    """

    unbuilt: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _known[class_path(cls)] = cls


def class_path(of: type[Any]) -> str:
    """The path by which a checkpoint names a class: its module and its name."""
    return f"{of.__module__}.{of.__qualname__}"


def stored_class(path: object, kind: type[Kind]) -> type[Kind]:
    """The class that a checkpoint names, which is a ``kind``.

    Raises:
        LookupError: there is none of that path.
    """
    module = str(path).rpartition(".")[0]
    ours = module.startswith(f"{METHODS}.")
    # Which packages are installed takes a while to find out.
    if ours or module in {point.module for point in entry_points(group=METHODS)}:
        with suppress(ImportError, ValueError, RecursionError):  # of a module in a thousand others
            import_module(module)
    known = _known.get(str(path))
    if known is None or not issubclass(known, kind):
        raise LookupError(str(path))
    return known

"""What may be wrong with a scene that can be read, each with its place and its remedy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Advice:
    """One thing that will make the result worse than it could be.

    Attributes:
        where: the file, the view or the part of the scene.
        what: what was found there.
        remedy: what to do.
    """

    where: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}; {self.remedy}"


def listed(names: Sequence[str], most: int = 3) -> str:
    """The first ``most`` of some names, and how many more there are."""
    shown = ", ".join(names[:most])
    more = len(names) - most
    return shown if more <= 0 else f"{shown} and {more} more"

"""What a check has found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Finding:
    """What a check has found.

    Attributes:
        held: whether what is promised was kept.
        said: the figures that matter, in a few words on one line.
        figures: all of them by name, as plain data.
    """

    held: bool
    said: str
    figures: dict[str, Any] = field(default_factory=dict)

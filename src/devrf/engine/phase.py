"""A phase: a part of a stage's schedule."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A range of iterations in which the same tensors are learned.

    Between two phases grids grow, or another frame becomes active.

    Attributes:
        kind: what is learned, in a word or two: ``search``, ``fine``, ``level 2``.
        start: first iteration.
        stop: one past the last iteration.
        frame: the frame that is learned; None where all times are learned at once.
    """

    kind: str
    start: int
    stop: int
    frame: int | None = None

    @property
    def cost(self) -> float:
        """How long an iteration takes, about, in a unit that the stage's phases share."""
        return 1.0

"""A phase of a stage's schedule."""

from __future__ import annotations

from typing import Protocol


class Phase(Protocol):
    """A range of iterations in which the same tensors are learned."""

    @property
    def start(self) -> int:
        """First iteration."""
        ...

    @property
    def stop(self) -> int:
        """One past the last iteration."""
        ...

    @property
    def kind(self) -> str:
        """What is learned, in a word or two: ``search``, ``fine``, ``level 2``."""
        ...

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames that are learned, ascending; empty where all times are learned at once."""
        ...


def in_words(frames: tuple[int, ...]) -> str:
    """``frame 3``, or ``frames 3, 10``."""
    noun = "frame" if len(frames) == 1 else "frames"
    return f"{noun} {', '.join(str(frame) for frame in frames)}"

"""Whether frames that are being learned have anything left to gain."""

from __future__ import annotations

from collections.abc import Sequence


class ConvergenceMonitor:
    """Follows the loss of each active frame over the Lightning steps of a phase.

    Attributes:
        losses: mean loss of each step so far, by active frame.
    """

    def __init__(self, frames: int, min_rel_improvement: float | None) -> None:
        """Begin with no losses.

        Args:
            frames: how many are learned together.
            min_rel_improvement: see :func:`converged`; None: no frame ever converges.
        """
        self.losses: list[list[float]] = [[] for _ in range(frames)]
        self._gain = min_rel_improvement

    def add(self, losses: Sequence[float]) -> bool:
        """Note the losses of a step, one a frame; whether all frames have converged."""
        for seen, loss in zip(self.losses, losses, strict=True):
            seen.append(loss)
        gain = self._gain
        return gain is not None and all(converged(seen, gain) for seen in self.losses)


def converged(losses: Sequence[float], min_rel_improvement: float) -> bool:
    """Whether the last two Lightning steps have gained too little to go on.

    Two, since one may have drawn difficult pixels; at least three steps tell.

    Args:
        losses: mean loss of each step so far.
        min_rel_improvement: the share of the loss that two steps must take off the best one
            before them.
    """
    if len(losses) < 3:
        return False
    return min(losses[-2:]) > (1 - min_rel_improvement) * min(losses[:-2])

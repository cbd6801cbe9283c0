"""Whether the active frames have anything left to gain (docs/method.md#coarse-to-fine)."""

from __future__ import annotations

from collections.abc import Sequence


class ConvergenceMonitor:
    """Follows the loss of each active frame over the Lightning steps of a phase.

    Attributes:
        losses: mean loss of each step so far, by active frame.
    """

    def __init__(self, frames: int, min_rel_improvement: float | None) -> None:
        """No losses yet of ``frames`` frames; ``min_rel_improvement`` None: none ever converges."""
        self.losses: list[list[float]] = [[] for _ in range(frames)]
        self._gain = min_rel_improvement

    def add(self, losses: Sequence[float]) -> bool:
        """Note the losses of a step, one a frame; whether all frames have converged."""
        for seen, loss in zip(self.losses, losses, strict=True):
            seen.append(loss)
        gain = self._gain
        return gain is not None and all(converged(seen, gain) for seen in self.losses)


def converged(losses: Sequence[float], min_rel_improvement: float) -> bool:
    """Whether the last two steps took less than ``min_rel_improvement`` off the best loss before.

    Two, since one may have drawn difficult pixels; at least three steps tell.
    """
    if len(losses) < 3:
        return False
    return min(losses[-2:]) > (1 - min_rel_improvement) * min(losses[:-2])

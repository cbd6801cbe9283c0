"""Whether a frame has anything left to gain."""

from __future__ import annotations

from collections.abc import Sequence


def converged(losses: Sequence[float], min_rel_improvement: float) -> bool:
    """Whether the last two steps took less than ``min_rel_improvement`` off the best loss before.

    Two, since one may have drawn difficult pixels; fewer than three steps never tell.

    Args:
        losses: mean loss of each Lightning step of a visit.
        min_rel_improvement: a share of the loss, in (0, 1].
    """
    if len(losses) < 3:
        return False
    return min(losses[-2:]) > (1 - min_rel_improvement) * min(losses[:-2])

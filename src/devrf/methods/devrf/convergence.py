"""Whether a visit to a frame has anything left to gain."""

from __future__ import annotations

from collections.abc import Sequence


def settled(losses: Sequence[float], gain: float) -> bool:
    """Whether the last two of a visit's Lightning steps have gained too little to go on.

    Two, since one may have drawn dear pixels; at least three steps tell.

    Args:
        losses: mean loss of each step of the visit so far.
        gain: the share of the loss that two steps must take off the best one before them.
    """
    if len(losses) < 3:
        return False
    return min(losses[-2:]) > (1 - gain) * min(losses[:-2])

"""Total variation of grids: its gradient is added by the optimiser, not by autograd."""

from __future__ import annotations


def total_variation_weight(weight: float, side: int, rays: int) -> float:
    """Factor of the gradient of the Huber total variation: ω·(side/128)/R/6.

    See docs/method.md#total-variation.

    Args:
        weight: ω, the term's weight.
        side: the longest side of the motion grid.
        rays: R, the rays of a batch.
    """
    return weight * (side / 128) / rays / 6

"""What counts as moving: the one rule of masks, scores, exports and viewers."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

# What leaves its first place by more than this share of the scene's radius moves.
MOVED = 0.05


def radius(points: Tensor) -> float:
    """The median distance of points (M, D) from their middle, the median along each axis.

    Neither a sky far away nor a few points that float about change it much. Of no points it is
    infinite: nothing moves.
    """
    if len(points) == 0:
        return math.inf
    return float((points - points.nanmedian(dim=0).values).norm(dim=1).nanmedian())


def moving(places: Iterable[Tensor], size: float) -> Tensor:
    """Mask (M,) of points that move (docs/stages.md#moving) in a scene of a radius ``size``.

    ``places`` (M, 3) are theirs at each time, first at rest.
    """
    remaining = iter(places)
    first = next(remaining)
    moves = torch.zeros_like(first[:, 0], dtype=torch.bool)
    for place in remaining:
        moves |= (place - first).norm(dim=1) > MOVED * size
    return moves

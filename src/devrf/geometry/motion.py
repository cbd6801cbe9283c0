"""What counts as moving: the one rule of masks, scores, exports and viewers."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

# What leaves its first place by more than this share of the scene's radius moves.
MOVED = 0.05


def radius(points: Tensor) -> float:
    """The median distance of points (M, 3) from their middle, the median along each axis.

    Neither a sky far away nor a few points that float about change it much.
    """
    return float((points - points.median(dim=0).values).norm(dim=1).median())


def farthest(places: Iterable[Tensor]) -> Tensor:
    """How far (M,) points get from their first place; ``places`` are (M, 3), one for each time."""
    remaining = iter(places)
    first = next(remaining)
    away = torch.zeros_like(first[:, 0])
    for place in remaining:
        away = torch.maximum(away, (place - first).norm(dim=1))
    return away


def moving(places: Iterable[Tensor], size: float) -> Tensor:
    """Mask (M,) of points that move (docs/stages.md#moving) in a scene of a radius ``size``."""
    return farthest(places) > MOVED * size

"""A mean over what is near matter that lets parts tear (docs/method.md#elastic)."""

from __future__ import annotations

from torch import Tensor

# c of docs/method.md#elastic and #bending: beyond it matter counts as torn or jointed, not as
# stretched or bent.
TEARING = 0.1


def robust_mean(energy: Tensor, counted: Tensor) -> Tensor:
    """Mean () over the counted places of c E / (c + E); 0 where none counts.

    Args:
        energy: (X, Y, Z) E, without a unit.
        counted: (X, Y, Z) 1 for the places that count, else 0.
    """
    robust = energy * TEARING / (energy + TEARING)
    return (counted * robust).sum() / counted.sum().clamp(min=1)

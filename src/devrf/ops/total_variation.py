"""Total variation of a grid with a Huber penalty, and its gradient in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.ops.dispatch import triton_runs


def total_variation(grid: Tensor) -> Tensor:
    """Σ over pairs of neighbours of h(v − v'), h(d) = d²/2 for |d| ≤ 1 and |d| − 1/2 beyond.

    Args:
        grid: (X, Y, Z, C).

    Returns:
        A scalar: the sum over all channels and the six neighbours, each pair counted once.
    """
    return torch.stack(
        [
            torch.nn.functional.huber_loss(*_neighbours(grid, axis), reduction="sum")
            for axis in range(3)
        ]
    ).sum()


def add_total_variation_gradient(
    grid: Tensor, gradient: Tensor, weight: float, *, touched_only: bool = False
) -> None:
    """Add ``weight`` · ∂ total_variation(grid) / ∂ grid to ``gradient`` in place.

    The derivative at a voxel is Σ_neighbours clamp(v − v', −1, 1); in closed form, because an
    autograd graph over every voxel at every step would be slow.

    Args:
        grid: (X, Y, Z, C).
        gradient: the same shape.
        weight: factor of the penalty.
        touched_only: add only to entries that are not zero.
    """
    if grid.is_contiguous() and gradient.is_contiguous() and triton_runs(grid, gradient):
        from devrf.ops.kernels.adam import add_gradient_in_one_pass

        add_gradient_in_one_pass(grid, gradient, weight, touched_only=touched_only)
        return
    into = torch.zeros_like(gradient) if touched_only else gradient
    for axis in range(3):
        after, before = _neighbours(grid, axis)
        slope = (after - before).clamp_(-1, 1)
        into_after, into_before = _neighbours(into, axis)
        into_after.add_(slope, alpha=weight)
        into_before.sub_(slope, alpha=weight)
    if touched_only:
        gradient += into * (gradient != 0)


def _neighbours(grid: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    length = grid.shape[axis] - 1
    return grid.narrow(axis, 1, length), grid.narrow(axis, 0, length)

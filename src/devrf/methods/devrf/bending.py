"""How much a frame's motion changes from place to place (docs/method.md#bending)."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import max_pool3d

from devrf.geometry.box import Box
from devrf.methods.devrf.robust_mean import robust_mean

# ℓ, over which J's change is looked at, as a share of the box's longest edge.
REACH = 1 / 20


def bending_energy(displacement: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """Mean () over points near matter of c B / (c + B), B = ℓ² Σ_ij |∂_i ∂_j Δ|².

    The points are those of the grid that do not lie on its border, and are near matter if one of
    the eight cells around them holds some.

    Args:
        displacement: (X, Y, Z, 3) Δ in the box's units.
        box: where the grid lives.
        occupied: (X−1, Y−1, Z−1) 1 for cells that count, else 0.
    """
    if min(displacement.shape[:3]) < 3:
        return displacement.sum() * 0.0
    spacing = [
        edge / (count - 1) for edge, count in zip(box.size, displacement.shape, strict=False)
    ]
    total = displacement.new_zeros(())
    for i in range(3):
        for j in range(i, 3):
            curved = _second_difference(displacement, i, j) / (spacing[i] * spacing[j])
            total = total + (1 if i == j else 2) * curved.square().sum(dim=-1)
    energy = (max(box.size) * REACH) ** 2 * total
    return robust_mean(energy, max_pool3d(occupied[None], kernel_size=2, stride=1)[0])


def _second_difference(values: Tensor, i: int, j: int) -> Tensor:
    """Central second difference (X−2, Y−2, Z−2, 3) along axes ``i`` and ``j``, of spacing 1."""
    if i == j:
        before, here, after = (_shifted(values, i, offset) for offset in (-1, 0, 1))
        difference = before - 2 * here + after
    else:
        slope = (_shifted(values, i, 1) - _shifted(values, i, -1)) / 2
        difference = (_shifted(slope, j, 1) - _shifted(slope, j, -1)) / 2
    for axis in {0, 1, 2} - {i, j}:
        difference = _shifted(difference, axis, 0)
    return difference


def _shifted(values: Tensor, axis: int, offset: int) -> Tensor:
    """The values ``offset`` further along ``axis``, for all but its first and last."""
    return values.narrow(axis, 1 + offset, values.shape[axis] - 2)

"""Priors on a frame's forward slice: its stretching, and its bending.

See docs/method.md#elastic and docs/method.md#bending.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool3d, max_pool3d

from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.methods.devrf.extension import DeformationContext, Extension
from devrf.methods.devrf.losses import DeformationPrediction
from devrf.rendering.occupancy import Occupancy

# c of docs/method.md#elastic and #bending: beyond it a place counts as torn or jointed, not as
# stretched or bent.
TEARING = 0.1
# ℓ of the bending energy, over which J's change is looked at, as a share of the box's longest edge.
REACH = 1 / 20


def elastic_energy(displacement: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """Mean () over occupied cells of c E / (c + E), E = ‖JᵀJ − I‖²_F, J = I + ∇Δ.

    Args:
        displacement: (X, Y, Z, 3) Δ in the box's units.
        box: of the grid.
        occupied: (X−1, Y−1, Z−1) 1 for cells that count, else 0.
    """
    columns = []
    for axis, (edge, count) in enumerate(zip(box.size, displacement.shape, strict=False)):
        slope = _to_middles(displacement.diff(dim=axis), axis) * ((count - 1) / edge)
        columns.append(slope + torch.eye(3, device=slope.device, dtype=slope.dtype)[axis])
    energy = torch.zeros_like(occupied)
    for i in range(3):
        energy = energy + ((columns[i] * columns[i]).sum(dim=-1) - 1).square()
        for j in range(i):
            energy = energy + 2 * (columns[i] * columns[j]).sum(dim=-1).square()
    return _robust_mean(energy, occupied)


def _to_middles(slopes: Tensor, axis: int) -> Tensor:
    """Slopes along the edges of cells, parallel to ``axis``, to the middles of the cells."""
    for other in range(3):
        if other != axis:
            length = slopes.shape[other] - 1
            slopes = (slopes.narrow(other, 0, length) + slopes.narrow(other, 1, length)) / 2
    return slopes


def bending_energy(displacement: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """Mean () over points near occupied cells of c B / (c + B), B = ℓ² Σ_ij |∂_i ∂_j Δ|².

    The points are those of the grid that do not lie on its border, and count if one of the eight
    cells around them is occupied.

    Args:
        displacement: (X, Y, Z, 3) Δ in the box's units.
        box: of the grid.
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
    return _robust_mean(energy, max_pool3d(occupied[None], kernel_size=2, stride=1)[0])


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


def _robust_mean(energy: Tensor, counted: Tensor) -> Tensor:
    """Mean () over the counted places of c E / (c + E); 0 where none counts.

    Args:
        energy: (X, Y, Z) E, without a unit.
        counted: (X, Y, Z) 1 for the places that count, else 0.
    """
    robust = energy * TEARING / (energy + TEARING)
    return (counted * robust).sum() / counted.sum().clamp(min=1)


@torch.no_grad()
def occupied_cells(occupancy: Occupancy, box: Box, shape: tuple[int, int, int]) -> Tensor:
    """(X−1, Y−1, Z−1) 1 for the occupied cells of a grid of ``shape`` over ``box``, else 0.

    The occupancy is looked up at as many points of the box as it has.
    """
    x, y, z = occupancy.mask.shape
    occupied = occupancy.on((x, y, z), box)[None].float()
    return adaptive_max_pool3d(occupied, [count - 1 for count in shape])[0]


class DeformationPrior(Extension):
    """Adds an energy of the forward slice to the loss terms, where something is at rest."""

    def __init__(self, name: str, energy: Callable[[Tensor, Box, Tensor], Tensor]) -> None:
        """An ``energy`` of Δ (X, Y, Z, 3), its box and the occupied cells (X−1, Y−1, Z−1).

        ``loss.deformation`` has its weight under ``name``.
        """
        self.name = name
        self.energy = energy
        self.terms = {name: self._term}
        self._occupied: Tensor | None = None

    def begin_level(self, context: DeformationContext, level: int) -> None:
        """Find the cells of the level's grids that are occupied at rest."""
        if self.name in context.weights:
            field = context.field
            occupancy = context.model.occupancy
            self._occupied = occupied_cells(occupancy, field.box, field.shape)

    def _term(self, prediction: DeformationPrediction) -> Tensor:
        assert self._occupied is not None, "the level has not begun"
        return self.energy(prediction.forward_slice, prediction.box, self._occupied)


class Elastic(DeformationPrior):
    """Resists stretching; parts may tear off one another (docs/method.md#elastic)."""

    def __init__(self, initial_factor: float = 1.0) -> None:
        """Choose its factor at the start of a visit at the coarsest level.

        Args:
            initial_factor: of its weight; it goes to 1 at the visit's end, exponentially.
        """
        super().__init__("elastic", elastic_energy)
        key = "schedule.extensions.elastic.initial_factor"
        expect(0 < initial_factor < math.inf, key, "a number above 0", initial_factor)
        self._initial_factor = initial_factor

    def weight_factor(self, term: str, level: int, share: float) -> float:
        """Stiff while a visit at the coarsest level finds where things are, soft at its end."""
        stiff = term == self.name and level == 0
        return self._initial_factor ** (1 - share) if stiff else 1.0


class Bending(DeformationPrior):
    """Resists bending; parts may turn against one another (docs/method.md#bending)."""

    def __init__(self) -> None:
        super().__init__("bending", bending_energy)

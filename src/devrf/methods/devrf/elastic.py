"""How much a frame's motion stretches matter (docs/method.md#elastic)."""

from __future__ import annotations

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.robust_mean import robust_mean
from devrf.rendering.occupancy import Occupancy


def elastic_energy(displacement: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """Mean () over occupied cells of c E / (c + E), E = ‖JᵀJ − I‖²_F, J = I + ∇Δ.

    Args:
        displacement: (X, Y, Z, 3) Δ in the box's units.
        box: where the grid lives.
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
    return robust_mean(energy, occupied)


@torch.no_grad()
def occupied_cells(occupancy: Occupancy, box: Box, shape: tuple[int, int, int]) -> Tensor:
    """(X−1, Y−1, Z−1) 1 for the cells of a grid of ``shape`` over ``box`` that hold matter, else 0.

    Matter is looked up at as many points of the box as the occupancy has.
    """
    x, y, z = occupancy.mask.shape
    points = box.grid_points((x, y, z), torch.zeros((), device=occupancy.mask.device))
    found = occupancy.at(points.view(-1, 3)).view(1, x, y, z)
    cells = [count - 1 for count in shape]
    return torch.nn.functional.adaptive_max_pool3d(found.float(), cells)[0]


def _to_middles(slopes: Tensor, axis: int) -> Tensor:
    """Slopes along the edges of cells, parallel to ``axis``, to the middles of the cells."""
    for other in range(3):
        if other != axis:
            length = slopes.shape[other] - 1
            slopes = (slopes.narrow(other, 0, length) + slopes.narrow(other, 1, length)) / 2
    return slopes

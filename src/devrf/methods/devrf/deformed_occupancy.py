"""Where something is at a time t (docs/method.md#occupancy)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.rendering.occupancy import Occupancy, dilate


@torch.no_grad()
def deformed_occupancy(
    occupancy: Occupancy, canonical: CanonicalField, warp: Callable[[Tensor], Tensor]
) -> Occupancy:
    """The occupancy at a time: the grid points whose canonical position is occupied, grown by one.

    Args:
        occupancy: where something is at rest.
        canonical: gives the box.
        warp: x → x + Δ_b(x, t), points (M, 3) at the time into canonical space.
    """
    points = occupancy_points(occupancy, canonical)
    moved = warp(points.view(-1, 3)).view(points.shape)
    return occupancy_through(occupancy, canonical, moved)


def occupancy_points(occupancy: Occupancy, canonical: CanonicalField) -> Tensor:
    """The grid points x (X, Y, Z, 3) at which a time's occupancy is looked up."""
    x, y, z = occupancy.mask.shape
    return canonical.box.grid_points((x, y, z), canonical.density.values)


@torch.no_grad()
def occupancy_through(occupancy: Occupancy, canonical: CanonicalField, moved: Tensor) -> Occupancy:
    """:func:`deformed_occupancy` of grid points with canonical positions ``moved`` (X, Y, Z, 3).

    The rim of one grid point is for what lies between the points.
    """
    found = occupancy.at(moved.view(-1, 3)).view(moved.shape[:3])
    return Occupancy(dilate(found, 1), canonical.box)

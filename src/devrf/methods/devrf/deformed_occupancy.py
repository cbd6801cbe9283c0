"""Where something is once it has moved."""

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
    """Where something is at a time: the grid points that the time's warp sends to matter.

    Args:
        occupancy: where something is at rest.
        canonical: gives the box.
        warp: maps points (M, 3) at the time into canonical space.
    """
    points = occupancy_points(occupancy, canonical)
    moved = warp(points.view(-1, 3)).view(points.shape)
    return occupancy_through(occupancy, canonical, moved)


def occupancy_points(occupancy: Occupancy, canonical: CanonicalField) -> Tensor:
    """The grid points (X, Y, Z, 3) at which a time's occupancy is looked up."""
    x, y, z = occupancy.mask.shape
    return canonical.box.grid_points((x, y, z), canonical.density.values)


@torch.no_grad()
def occupancy_through(occupancy: Occupancy, canonical: CanonicalField, moved: Tensor) -> Occupancy:
    """The occupancy of a time whose grid points are seen at ``moved`` (X, Y, Z, 3).

    The canonical occupancy has a rim of one grid point, for what a stretching warp would step
    over; so has the result, for what lies between its own grid points.
    """
    found = occupancy.at(moved.view(-1, 3)).view(moved.shape[:3])
    return Occupancy(dilate(found, 1), canonical.box)

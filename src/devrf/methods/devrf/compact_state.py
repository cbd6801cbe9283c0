"""The state of a finished scene as its checkpoint holds it.

Grids are packed (:mod:`devrf.checkpoints.stored_grids`): in half precision, in detail only near
what is ever occupied. Progress files hold everything as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import pack, unpack
from devrf.geometry.box import Box
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.deformation_field import DeformationField, FrameField
from devrf.ops.corners import shape_of
from devrf.rendering.occupancy import Occupancy, dilate

Shape = tuple[int, int, int]


@torch.no_grad()
def compact_state(
    state: Mapping[str, Any],
    occupancy: Occupancy,
    canonical: CanonicalField,
    deformation: DeformationField | None,
    occupancy_at: Callable[[float], Occupancy],
    color_residual: FrameField | None = None,
    *,
    unbounded: bool,
) -> dict[str, Any]:
    """The ``state`` of a finished scene with its grids packed.

    A grid with a value that half precision cannot hold stays as it is.

    Args:
        state: the model's.
        occupancy: where something is at rest.
        canonical: the canonical field.
        deformation: how it deforms, or None.
        occupancy_at: where something is at a time.
        color_residual: how its colours change, or None.
        unbounded: whether rays end in the field: its outer faces are then kept.
    """
    small = dict(state)
    at_rest = _near(occupancy, canonical.density.shape, canonical.box)[None]
    if unbounded:
        rim = torch.ones_like(at_rest)
        rim[:, 1:-1, 1:-1, 1:-1] = False
        at_rest |= rim
    for name in ("canonical.density.values", "canonical.color.values"):
        small[name] = _packed(small[name][None], at_rest, smooth=False, many=False)
    if deformation is not None:
        shape, box = deformation.shape, deformation.box
        moments = [_near(occupancy_at(time), shape, box) for time in deformation.clock.times]
        # Between two frames both are blended.
        moving = torch.stack(
            [torch.stack(moments[max(k - 1, 0) : k + 2]).any(dim=0) for k in range(len(moments))]
        )
        frames = "deformation.frames."
        small[f"{frames}to_canonical"] = _packed(deformation.to_canonical, moving, smooth=True)
        at_rest = _near(occupancy, shape, box)[None]
        small[f"{frames}to_time"] = _packed(deformation.to_time, at_rest, smooth=True)
    if color_residual is not None:
        values = color_residual.values
        at_rest = _near(occupancy, shape_of(values[0]), color_residual.box)[None]
        small["color_residual.values"] = _packed(values, at_rest, smooth=False)
    return small


def expanded_state(state: dict[str, Any]) -> dict[str, Any]:
    """A model's state from what :func:`compact_state` gave; a full state passes through.

    Raises:
        KeyError: a packed grid lacks a part.
        ValueError: its parts do not fit together.
    """
    return {
        name: _unpacked(value) if isinstance(value, dict) and "kept" in value else value
        for name, value in state.items()
    }


def _packed(grids: Tensor, keep: Tensor, *, smooth: bool, many: bool = True) -> Any:
    try:
        return {**pack(grids.cpu(), keep.cpu(), smooth=smooth), "many": many}
    except ValueError:
        return grids if many else grids[0]


def _unpacked(packed: dict[str, Any]) -> Tensor:
    grids = unpack(packed)
    return grids if packed["many"] else grids[0]


def _near(occupancy: Occupancy, shape: Shape, box: Box) -> Tensor:
    """The points of a grid over ``box`` that interpolation near anything occupied reads."""
    cells = zip(occupancy.mask.shape, shape, strict=True)
    # A cell of the grid may span several of the occupancy's cells.
    reach = max(1, *(-(-(theirs - 1) // max(ours - 1, 1)) for theirs, ours in cells))
    grown = Occupancy(dilate(occupancy.mask, reach), occupancy.box)
    points = box.grid_points(shape, torch.empty(0, device=occupancy.mask.device))
    return dilate(grown.at(points.view(-1, 3)).view(shape), 1)

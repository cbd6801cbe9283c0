"""Occupancy: a mask of the cells that may be occupied, so that empty space is not sampled."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from devrf.geometry.box import Box
from devrf.ops.march import OccupancyDistances
from devrf.system.plain_data import validate


class Occupancy(nn.Module):
    """A mask (X, Y, Z) over a box; a point reads its nearest grid point.

    Attributes:
        mask: (X, Y, Z) bool, True where the scene may be.
        box: the box of the mask; outside it everything is empty.
    """

    mask: Tensor
    _distances: Tensor | None

    # Distances to occupied cells are counted up to this many.
    FARTHEST = 8

    def __init__(self, mask: Tensor, box: Box) -> None:
        super().__init__()
        self.box = box
        self.register_buffer("mask", mask)
        self.register_buffer("_distances", None, persistent=False)

    @staticmethod
    def full(shape: tuple[int, int, int], box: Box) -> Occupancy:
        """A mask that is True in the whole box."""
        return Occupancy(torch.ones(shape, dtype=torch.bool), box)

    @property
    def distances(self) -> OccupancyDistances:
        """Distances to occupied cells, by which rays skip empty space."""
        return OccupancyDistances(self.find_distances(), self.box)

    def find_distances(self) -> Tensor:
        """Cells (X, Y, Z) to the nearest occupied one, uint8, computed once for a mask."""
        if self._distances is None:
            grown, cells = self.mask, (~self.mask).to(torch.uint8)
            for _ in range(self.FARTHEST - 1):
                grown = dilate(grown, 1)
                cells += ~grown
            self._distances = cells
        return self._distances

    @property
    def cell(self) -> float:
        """The shortest edge of a cell, in the box's units."""
        return min(edge / (n - 1) for edge, n in zip(self.box.size, self.mask.shape, strict=True))

    @property
    def share(self) -> float:
        """Share of the cells that are occupied."""
        return float(self.mask.float().mean())

    def at(self, points: Tensor) -> Tensor:
        """Mask (M,) of the ``points`` (M, 3) that may be occupied."""
        # A border of empty cells stands for all points outside, and for NaN.
        bordered = pad(self.mask, (1, 1) * 3)
        row = torch.zeros(len(points), dtype=torch.int32, device=points.device)
        # Axis by axis: several times faster than rows of three.
        for axis, count in enumerate(self.mask.shape):
            scale = (count - 1) / self.box.size[axis]
            index = points[:, axis].sub(self.box.low[axis]).mul_(scale).nan_to_num_(nan=-1.0)
            row.mul_(count + 2).add_(index.round_().clamp_(-1, count).to(torch.int32).add_(1))
        return bordered.view(-1).index_select(0, row)

    def points_near(self, shape: tuple[int, int, int], box: Box) -> Tensor:
        """Mask of a grid's points over ``box`` that interpolation near occupied cells reads."""
        cells = zip(self.mask.shape, shape, strict=True)
        # A cell of the grid may span several of the occupancy's cells.
        reach = max(1, *(-(-(theirs - 1) // max(ours - 1, 1)) for theirs, ours in cells))
        grown = Occupancy(dilate(self.mask, reach), self.box)
        return dilate(grown.on(shape, box), 1)

    def on(self, shape: tuple[int, int, int], box: Box) -> Tensor:
        """The mask at the points of a grid of ``shape`` over ``box``."""
        if shape == tuple(self.mask.shape) and box == self.box:
            return self.mask
        points = box.grid_points(shape, torch.empty(0, device=self.mask.device))
        return self.at(points.view(-1, 3)).view(shape)

    def replace(self, mask: Tensor, box: Box | None = None) -> None:
        """Replace the mask by one of any shape, and the box if one is given."""
        self.mask = mask
        self._distances = None
        self.box = box or self.box

    def refill(self, other: Occupancy) -> None:
        """Copy another occupancy of the same shape and box into the same memory."""
        self.mask.copy_(other.mask)
        self._distances = other._distances

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        stored = state_dict.get(prefix + "mask")
        if stored is not None and stored.ndim == 3 and min(stored.shape) >= 2:
            self.replace(self.mask.new_empty(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def get_extra_state(self) -> dict[str, Any]:
        """The box as plain numbers."""
        return {"low": list(self.box.low), "high": list(self.box.high)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the state of :meth:`get_extra_state`."""
        self.box = validate(Box, state)


def dilate(mask: Tensor, radius: int) -> Tensor:
    """The mask (X, Y, Z) grown by ``radius`` grid points along every axis and diagonal."""
    grown = mask
    # One axis after another, by shifted copies: faster than pooling.
    for axis in range(3):
        before, grown = grown, grown.clone()
        for shift in range(1, min(radius, mask.shape[axis] - 1) + 1):
            length = mask.shape[axis] - shift
            grown.narrow(axis, shift, length).logical_or_(before.narrow(axis, 0, length))
            grown.narrow(axis, 0, length).logical_or_(before.narrow(axis, shift, length))
    return grown


def bounding_box(mask: Tensor, box: Box) -> Box | None:
    """The smallest box around the True grid points of ``mask`` over ``box``; None if empty.

    It is at least one grid cell wide along each axis.
    """
    low, high = [], []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        used = mask.any(dim=others[1]).any(dim=others[0]).nonzero()[:, 0]
        if len(used) == 0:
            return None
        cell = box.size[axis] / (mask.shape[axis] - 1)
        first, last = int(used[0]), int(used[-1])
        if first == last:
            first, last = max(first - 1, 0), min(last + 1, mask.shape[axis] - 1)
        low.append(box.low[axis] + first * cell)
        high.append(box.low[axis] + last * cell)
    return Box.of(low, high)

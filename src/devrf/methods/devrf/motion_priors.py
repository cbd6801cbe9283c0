"""Priors on the motion itself, whatever the views show (docs/method.md#motion-priors)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.methods.devrf.active_frame import ActiveFrame
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.rendering.occupancy import Occupancy

# c of docs/method.md#elastic: the strain beyond which a cell counts as torn, not as stretched.
TEARING = 0.1


@dataclass
class Surroundings:
    """What the priors compare an active frame with, in memory that stays.

    Attributes:
        at_rest: (X−1, Y−1, Z−1) 1 where a cell of the motion grid may hold matter at rest, else 0.
        between: (X, Y, Z, 3) Δ_f halfway in time between the frames around this one.
        has_both: () 1 if both of these frames have been learned, else 0.
    """

    at_rest: Tensor
    between: Tensor
    has_both: Tensor


class MotionPriors:
    """The weighted sum of the elastic and the acceleration term of each active frame.

    A term whose weight is 0 is not computed.
    """

    def __init__(self, *, elastic: float = 0.0, acceleration: float = 0.0) -> None:
        self.elastic = elastic
        self.acceleration = acceleration
        self._around: list[Surroundings] = []

    def allocate(self, count: int, motion: DeformationField, occupancy: Occupancy) -> None:
        """Make memory for ``count`` frames at the field's present resolution.

        Args:
            count: active frames.
            motion: the deformation field.
            occupancy: where something is at rest.
        """
        self._around = []
        if not (self.elastic or self.acceleration):
            return
        at_rest = occupied_cells(occupancy, motion.shape)
        for _ in range(count):
            between = motion.frames.here.new_zeros(*motion.shape, 3)
            around = Surroundings(at_rest, between, at_rest.new_zeros(()))
            self._around.append(around)

    @torch.no_grad()
    def enter(self, numbers: Sequence[int], motion: DeformationField, *, learned: bool) -> None:
        """Turn to other frames, as many as there is memory for.

        Args:
            numbers: the frames.
            motion: the deformation field.
            learned: whether the frames after them have been learned, at this level or before.
        """
        times, frames = motion.clock.times, motion.frames
        for around, number in zip(self._around, numbers, strict=False):
            has_both = learned and number + 1 < len(times)
            around.has_both.fill_(float(has_both))
            if has_both:
                after = torch.empty_like(around.between)
                frames.read_forward(number - 1, around.between)
                frames.read_forward(number + 1, after)
                span = times[number + 1] - times[number - 1]
                around.between.lerp_(after, (times[number] - times[number - 1]) / span)

    def __call__(self, number: int, frame: ActiveFrame) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum () of an active frame's terms, and each unweighted by name, detached.

        Args:
            number: its position among the active frames.
            frame: the frame.
        """
        terms: dict[str, Tensor] = {}
        total = frame.forward.new_zeros(())
        if self.elastic:
            around = self._around[number]
            terms["elastic"] = elastic(frame.forward, frame.box, around.at_rest)
            total = total + self.elastic * terms["elastic"]
        if self.acceleration:
            around = self._around[number]
            missed = acceleration(frame.forward, around.between, frame.box, around.at_rest)
            terms["acceleration"] = around.has_both * missed
            total = total + self.acceleration * terms["acceleration"]
        return total, {name: value.detach() for name, value in terms.items()}


def elastic(displacement: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """L_elastic = mean over occupied cells of c E / (c + E), E = ‖JᵀJ − I‖²_F.

    See docs/method.md#elastic.

    Args:
        displacement: (X, Y, Z, 3) Δ in the box's units.
        box: where the grid lives.
        occupied: (X−1, Y−1, Z−1) 1 for cells that count, else 0.
    """
    columns = []
    for axis, (edge, count) in enumerate(zip(box.size, displacement.shape, strict=False)):
        slope = _mean_of_neighbours(displacement.diff(dim=axis), axis) * ((count - 1) / edge)
        columns.append(slope + torch.eye(3, device=slope.device, dtype=slope.dtype)[axis])
    energy = torch.zeros_like(occupied)
    for i in range(3):
        energy = energy + ((columns[i] * columns[i]).sum(dim=-1) - 1).square()
        for j in range(i):
            energy = energy + 2 * (columns[i] * columns[j]).sum(dim=-1).square()
    robust = energy * TEARING / (energy + TEARING)
    return (occupied * robust).sum() / occupied.sum().clamp(min=1)


def acceleration(displacement: Tensor, between: Tensor, box: Box, occupied: Tensor) -> Tensor:
    """L_acceleration = mean over occupied cells of |Δ − Δ_between|² / ℓ², ℓ the longest edge.

    See docs/method.md#acceleration.

    Args:
        displacement: (X, Y, Z, 3) Δ_f(·, t) in the box's units.
        between: (X, Y, Z, 3) its neighbours' in time, interpolated at t.
        box: where the grids live.
        occupied: (X−1, Y−1, Z−1) 1 for cells that count, else 0.
    """
    missed = ((displacement - between) / box.longest).square().sum(dim=-1)
    for axis in range(3):
        missed = _mean_of_pairs(missed, axis)
    return (occupied * missed).sum() / occupied.sum().clamp(min=1)


def occupied_cells(occupancy: Occupancy, shape: tuple[int, int, int]) -> Tensor:
    """(X−1, Y−1, Z−1) 1 for the cells of a grid of ``shape`` over the same box that are occupied.

    Those that any occupied point of the occupancy's own grid lies in; 0 for the others.
    """
    cells = [count - 1 for count in shape]
    mask = occupancy.mask[None].float()
    return torch.nn.functional.adaptive_max_pool3d(mask, cells)[0]


def _mean_of_neighbours(slopes: Tensor, axis: int) -> Tensor:
    """Slopes along the edges of cells, parallel to ``axis``, to the middles of the cells."""
    for other in range(3):
        if other != axis:
            slopes = _mean_of_pairs(slopes, other)
    return slopes


def _mean_of_pairs(values: Tensor, axis: int) -> Tensor:
    length = values.shape[axis] - 1
    return (values.narrow(axis, 0, length) + values.narrow(axis, 1, length)) / 2

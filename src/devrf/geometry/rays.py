"""Rays: origin, direction and viewing direction, in the fields' space."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor

# A smaller component of a direction is replaced by this before a division.
PARALLEL = 1e-9


@dataclass(frozen=True)
class Rays:
    """M rays.

    Attributes:
        origins: (M, 3) start points, in the fields' space (world units, or NDC).
        directions: (M, 3) unit vectors in world space; in NDC, from the near to the far plane.
        viewdirs: (M, 3) unit viewing directions in world space, for the colour decoder.
    """

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Self:
        """The rays at ``index``: a slice, a mask (M,) or positions (K,)."""
        return self._mapped(lambda of_rays: of_rays[index])

    def at(self, ray: Tensor, distance: Tensor) -> Tensor:
        """Points (S, 3) at ``distance`` (S,) along the rays numbered ``ray`` (S,).

        They lie in memory axis by axis: operations on millions of points are several times
        faster on whole vectors than on rows of three.
        """
        origins = self.origins.t().contiguous().index_select(1, ray)
        directions = self.directions.t().contiguous().index_select(1, ray)
        return origins.addcmul_(directions, distance).t()

    def to(self, device: torch.device | str) -> Self:
        """The same rays on ``device``."""
        return self._mapped(lambda of_rays: of_rays.to(device))

    def crossing(self, low: Tensor, high: Tensor, near: float, far: float) -> tuple[Tensor, Tensor]:
        """Distances (M,), (M,) at which rays enter and leave a box, within [near, far].

        The slab method. A ray that misses the box has entry > exit.

        Args:
            low: (3,) the box's corner with the smallest coordinates, in the rays' space.
            high: (3,) the one with the largest.
            near: the least distance; entry is negative for a ray that starts inside, if it is.
            far: the largest distance.
        """
        d = self.directions
        d = torch.where(d.abs() < PARALLEL, PARALLEL, d)
        to_low = (low - self.origins) / d
        to_high = (high - self.origins) / d
        entry = torch.minimum(to_low, to_high).amax(dim=-1)
        leave = torch.maximum(to_low, to_high).amin(dim=-1)
        return entry.clamp(min=near), leave.clamp(max=far)

    def longest(
        self, low: Sequence[float], high: Sequence[float], near: float, far: float
    ) -> float:
        """A bound of exit − entry of :meth:`crossing`, for directions of at least unit length."""
        return max(min(far - near, math.dist(low, high)), 0.0)

    @property
    def pace(self) -> float:
        """The most units of the fields' space in a unit of distance; 0 without rays."""
        return float(self.directions.norm(dim=1).amax()) if len(self) else 0.0

    def ends(self) -> Tensor | None:
        """Points (M, 3) at infinity in the fields' space; None where they are not in it."""
        return None

    @staticmethod
    def joined(parts: Sequence[Rays]) -> Rays:
        """The rays of several parts of one space, one part after another."""
        names = parts[0]._tensors()
        tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **tensors)

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> Self:
        return replace(self, **{name: change(value) for name, value in self._tensors().items()})

    def _tensors(self) -> dict[str, Tensor]:
        """The tensors with a row for each ray, by the attribute's name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}

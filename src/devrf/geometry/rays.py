"""Rays: half-lines through pixels, in whatever space the fields live in."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """M rays.

    Attributes:
        origins: (M, 3) start points, in the fields' space (world units, or NDC).
        directions: (M, 3) unit vectors in world space; in NDC, from the near to the far plane.
        viewdirs: (M, 3) unit viewing directions in world space, what the colour decoder sees.
    """

    origins: Tensor
    directions: Tensor
    viewdirs: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        """The rays at ``index``: a slice, a mask (M,) or positions (K,)."""
        return Rays(self.origins[index], self.directions[index], self.viewdirs[index])

    def at(self, ray: Tensor, distance: Tensor) -> Tensor:
        """Points (S, 3) at ``distance`` (S,) along the rays numbered ``ray`` (S,).

        They lie in memory axis by axis: what is done to millions of points is several times
        faster on whole vectors than on rows of three.
        """
        origins = self.origins.t().contiguous().index_select(1, ray)
        directions = self.directions.t().contiguous().index_select(1, ray)
        return origins.addcmul_(directions, distance).t()

    def to(self, device: torch.device | str) -> Rays:
        """The same rays on ``device``."""
        return Rays(self.origins.to(device), self.directions.to(device), self.viewdirs.to(device))

"""The canonical field: what the scene looks like at rest, as density and colour grids."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from devrf.geometry.box import Box
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.voxel_grid import VoxelGrid


class CanonicalField(nn.Module):
    """A voxel radiance field over a box (docs/method.md#canonical-field).

    Attributes:
        density: raw densities (X, Y, Z, 1), before the softplus.
        color: features (X, Y, Z, C) for the decoder.
        decoder: features and directions → RGB.
        box: where the field lives, in world units or NDC.
    """

    def __init__(
        self,
        box: Box,
        decoder: nn.Module,
        *,
        channels: int,
        voxels: int,
        base_voxels: int | None = None,
        alpha_init: float,
        planes: int | None = None,
    ) -> None:
        """Build an empty field.

        Args:
            box: where the field lives.
            decoder: maps (features, viewdirs, ray) to RGB.
            channels: features per voxel.
            voxels: about how many voxels to start with.
            base_voxels: how many there are at full resolution; step lengths are measured in
                voxels of that size. None: ``voxels``.
            alpha_init: opacity of one base voxel before anything is learned.
            planes: in NDC, how many planes stand one behind another at every resolution;
                then each plane starts with an equal share of every ray, the last one opaque.
                None for cubic voxels.
        """
        super().__init__()
        self.box = box
        self.base_voxels = base_voxels or voxels
        self.alpha_init = alpha_init
        self.voxels = voxels
        self.planes = planes
        shape = self.grid_shape(voxels)
        self.density = VoxelGrid(shape, 1)
        self.color = VoxelGrid(shape, channels)
        self.decoder = decoder
        if planes is not None:
            self._share_out(planes)

    @torch.no_grad()
    def _share_out(self, planes: int) -> None:
        """Give each of P planes the weight 1/P of every ray: α_k = 1 / (P − k), the last ≈ 1."""
        alpha = 1 / torch.arange(planes, 0, -1, dtype=torch.float64)
        tau = -torch.log1p(-alpha.clamp(max=1 - 1e-6))
        raw = torch.log(torch.expm1(tau / self.step_in_base_voxels(1.0))) - self.shift
        self.density.values[..., 0] = raw.float()

    @property
    def has_network(self) -> bool:
        """Whether colours come from a network: not in the coarse geometry search."""
        return isinstance(self.decoder, ColorDecoder)

    def grid_shape(self, voxels: int) -> tuple[int, int, int]:
        """Grid points along (x, y, z) for about ``voxels`` voxels."""
        if self.planes is None:
            return self.box.grid_shape(voxels)
        width, height, _ = self.box.size
        edge = (width * height * self.planes / voxels) ** 0.5
        return max(2, int(width / edge + 1e-6)), max(2, int(height / edge + 1e-6)), self.planes

    def step_length(self, step: float) -> float:
        """Length of ``step`` voxels along a ray, in units of the ray's direction.

        In NDC a direction leads from the first plane to the last, so that samples are evenly
        spaced in NDC depth.
        """
        if self.planes is None:
            return step * self.box.voxel_size(self.voxels)
        return step / (self.planes - 1)

    @property
    def shift(self) -> float:
        """b = log(1 / (1 − α_init) − 1): makes a raw density of 0 mean α_init."""
        return math.log(1 / (1 - self.alpha_init) - 1)

    def step_in_base_voxels(self, step: float) -> float:
        """δ of a step of ``step`` voxels: its length in voxels of the full resolution.

        In NDC, where the planes stay as they are, in units of 1/256 of the depth.
        """
        if self.planes is None:
            return step * self.box.voxel_size(self.voxels) / self.box.voxel_size(self.base_voxels)
        return step * 256 / self.planes

    def optical_depth(self, points: Tensor, delta: float) -> Tensor:
        """τ = softplus(v(x) + b)·δ (M,) at ``points`` (M, 3), for steps of δ base voxels."""
        raw = self.density(points, self.box)[:, 0]
        return torch.nn.functional.softplus(raw + self.shift) * delta

    def rgb(
        self,
        points: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        precision: torch.dtype = torch.float32,
    ) -> Tensor:
        """RGB (S, 3) at ``points`` (S, 3) on rays ``ray`` (S,) with ``viewdirs`` (R, 3).

        The decoder works in ``precision``; the result is in single precision.
        """
        color: Tensor = self.decoder(self.color(points, self.box), viewdirs, ray, precision)
        return color

    @torch.no_grad()
    def voxel_alpha(self, step: float) -> Tensor:
        """Opacity (X, Y, Z) of a step of ``step`` voxels at each grid point."""
        raw = self.density.values[..., 0]
        tau = torch.nn.functional.softplus(raw + self.shift) * self.step_in_base_voxels(step)
        return -torch.expm1(-tau)

    def resize(self, voxels: int) -> None:
        """Resample both grids to about ``voxels`` voxels; new parameters result."""
        self.voxels = voxels
        shape = self.grid_shape(voxels)
        self.density.resize(shape)
        self.color.resize(shape)

    @torch.no_grad()
    def clear(self, where: Tensor, alpha: float) -> None:
        """Make grid points empty: density down to opacity ``alpha`` a base voxel or less.

        Space that training never visited still holds the initial fog. A sample that the
        deformation sends there must meet nothing.

        Args:
            where: (X, Y, Z) bool, the points to empty.
            alpha: the opacity they may keep.
        """
        empty = math.log(math.expm1(-math.log1p(-alpha))) - self.shift
        raw = self.density.values[..., 0]
        raw[where] = raw[where].clamp(max=empty)

    def get_extra_state(self) -> dict[str, Any]:
        """What the tensors alone do not tell, as plain numbers."""
        return {
            "low": list(self.box.low),
            "high": list(self.box.high),
            "voxels": self.voxels,
            "base_voxels": self.base_voxels,
            "alpha_init": self.alpha_init,
            "planes": self.planes,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave."""
        self.box = Box.of(state["low"], state["high"])
        self.voxels = state["voxels"]
        self.base_voxels = state["base_voxels"]
        self.alpha_init = state["alpha_init"]
        self.planes = state["planes"]

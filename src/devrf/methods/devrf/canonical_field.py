"""The canonical field: the scene's look at rest, as density and colour grids."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge, Gt, Lt
from torch import Tensor, nn
from typing_extensions import TypedDict

from devrf.checkpoints.stored_grids import StoredShape
from devrf.geometry.box import Box
from devrf.kernels.trilinear import interpolate
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.ops.trilinear import resample, shape_of
from devrf.system.plain_data import validate


class Sizes(TypedDict):
    """A field's attributes in a checkpoint, beside the tensors and the box."""

    voxels: Annotated[int, Ge(1)]
    base_voxels: Annotated[int, Ge(1)]
    alpha_init: Annotated[float, Ge(1e-12), Lt(1)]
    planes: Annotated[int, Ge(2)] | None
    aspect: Annotated[float, Gt(0)]


class VoxelGrid(StoredShape):
    """Values at the points of a grid whose outer points lie on a box.

    Attributes:
        values: (X, Y, Z, C), channels last so that a grid point is one row of memory.
    """

    resizable: ClassVar = {"values": 3}  # a run may have ended at any resolution
    values: nn.Parameter

    def __init__(self, shape: tuple[int, int, int], channels: int) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(*shape, channels))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        return shape_of(self.values)

    def forward(self, points: Tensor, box: Box) -> Tensor:
        """Values (M, C) at ``points`` (M, 3), trilinear; outside ``box`` they are the border's."""
        return interpolate(self.values, points, box)

    @torch.no_grad()
    def resize(self, shape: tuple[int, int, int]) -> None:
        """Resample to another grid over the same box, trilinearly; a new parameter results."""
        self.values = nn.Parameter(resample(self.values, shape))


class CanonicalField(nn.Module):
    """A voxel radiance field over a box (docs/method.md#canonical-field).

    Attributes:
        density: raw densities v (X, Y, Z, 1), before the softplus.
        color: features f (X, Y, Z, C) for the decoder.
        decoder: features and directions → RGB.
        box: B, the field's box, in world units or NDC.
        voxels: N, the approximate number of the grids' voxels.
        base_voxels: the same at full resolution.
        alpha_init: opacity of one base voxel before anything is learned.
        planes: P, in NDC the number of planes along the rays at every resolution, from the box's
            front to its back; None for cubic voxels.
        aspect: in NDC, grid points across a unit of x to those across a unit of y.
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
        aspect: float = 1.0,
    ) -> None:
        """Build an empty field with C = ``channels`` features per voxel.

        The ``decoder`` maps (features, viewdirs, ray, residual) to RGB; ``base_voxels``
        None is ``voxels``. Each of ``planes`` starts with an equal share of every ray.
        """
        super().__init__()
        self.box = box
        self.voxels = voxels
        self.base_voxels = base_voxels or voxels
        self.alpha_init = alpha_init
        self.planes = planes
        self.aspect = aspect
        shape = self.grid_shape(voxels)
        self.density = VoxelGrid(shape, 1)
        self.color = VoxelGrid(shape, channels)
        self.decoder = decoder
        if planes is not None:
            self._equal_shares(planes)

    @torch.no_grad()
    def _equal_shares(self, planes: int) -> None:
        """Give each of P planes the weight 1/P of every ray: α_k = 1 / (P − k), the last ≈ 1."""
        alpha = 1 / torch.arange(planes, 0, -1, dtype=torch.float64)
        tau = -torch.log1p(-alpha.clamp(max=1 - 1e-6))
        raw = torch.log(torch.expm1(tau / self.step_in_base_voxels(1.0))) - self.shift
        self.density.values[..., 0] = raw.float()

    def grid_shape(self, voxels: int) -> tuple[int, int, int]:
        """Grid points along (x, y, z) for about ``voxels`` voxels."""
        return self.box.grid_shape(voxels, self.planes, self.aspect)

    def step_length(self, step: float) -> float:
        """Length of ``step`` voxels along a ray, in units of the ray's direction.

        In NDC that leads from the near plane to infinity: samples are evenly spaced in depth.
        """
        if self.planes is None:
            return step * self.box.voxel_size(self.voxels)
        return step * (self.box.size[2] / 2) / (self.planes - 1)

    def step_in_base_voxels(self, step: float) -> float:
        """δ = step · s / s_base, in NDC step · 256 / P · D / 2 (docs/method.md#step-length)."""
        if self.planes is None:
            return step * self.box.voxel_size(self.voxels) / self.box.voxel_size(self.base_voxels)
        return step * 256 / self.planes * (self.box.size[2] / 2)

    @property
    def shift(self) -> float:
        """b = log(1 / (1 − α_init) − 1): makes a raw density of 0 mean α_init."""
        return math.log(1 / (1 - self.alpha_init) - 1)

    def _tau(self, raw: Tensor, delta: float) -> Tensor:
        """τ = σδ with σ = softplus(v + b) (docs/method.md#density)."""
        return torch.nn.functional.softplus(raw + self.shift) * delta

    def optical_depth(self, points: Tensor, delta: float) -> Tensor:
        """τ (M,) at ``points`` (M, 3), for steps of δ base voxels."""
        return self._tau(self.density(points, self.box)[:, 0], delta)

    @torch.no_grad()
    def voxel_alpha(self, step: float) -> Tensor:
        """α (X, Y, Z) of a step of ``step`` voxels at each grid point."""
        return self.alpha(self.density.values[..., 0], step)

    def alpha(self, raw: Tensor, step: float) -> Tensor:
        """α of a step of ``step`` voxels where raw densities are ``raw``, of any shape."""
        return -torch.expm1(-self._tau(raw, self.step_in_base_voxels(step)))

    def rgb(
        self,
        points: Tensor,
        viewdirs: Tensor,
        ray: Tensor,
        residual: Tensor | None = None,
    ) -> Tensor:
        """RGB (S, 3) at ``points`` (S, 3) on rays ``ray`` (S,) with ``viewdirs`` (R, 3).

        ``residual`` (S, 3) is added before the sigmoid.
        """
        features = self.color(points, self.box)
        color: Tensor = self.decoder(features, viewdirs, ray, residual)
        return color

    def forget_directions(self) -> None:
        """Make colours the same from everywhere, until directions are learned."""
        assert isinstance(self.decoder, ColorDecoder)
        nn.init.zeros_(self.decoder.from_direction.weight)

    def learn_directions(self, whether: bool) -> bool:
        """Let the network learn from viewing directions, or not; return whether it begins to."""
        if not isinstance(self.decoder, ColorDecoder):
            return False
        begins = whether and not self.decoder.learns_directions
        self.decoder.learns_directions = whether
        return begins

    def resize(self, voxels: int) -> None:
        """Resample both grids to about ``voxels`` voxels; new parameters result."""
        self.voxels = voxels
        shape = self.grid_shape(voxels)
        self.density.resize(shape)
        self.color.resize(shape)

    @torch.no_grad()
    def clear(self, where: Tensor, alpha: float) -> None:
        """Lower the opacity of a base voxel to at most ``alpha`` at points ``where`` (X, Y, Z)."""
        empty = math.log(math.expm1(-math.log1p(-alpha))) - self.shift
        raw = self.density.values[..., 0]
        raw[where] = raw[where].clamp(max=empty)

    def get_extra_state(self) -> dict[str, Any]:
        """Box and sizes, as plain numbers."""
        sizes = {name: getattr(self, name) for name in Sizes.__annotations__}
        return {"low": list(self.box.low), "high": list(self.box.high), **sizes}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`get_extra_state`."""
        self.box = validate(Box, state)
        for name, size in validate(Sizes, state).items():
            setattr(self, name, size)

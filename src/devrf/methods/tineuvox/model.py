"""TiNeuVox (Fang et al., SIGGRAPH Asia 2022): time-aware neural voxels."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.space import Space
from devrf.methods.nerf.networks import SinusoidalEncoding, linear_by_ray, mlp
from devrf.methods.nerf.placed_model import DensityColorField
from devrf.methods.tineuvox.networks import MultiDistanceGrid, RadianceNetwork
from devrf.methods.tineuvox.settings import TiNeuVoxSettings
from devrf.ops.photometric import background_entropy, per_sample_color
from devrf.ops.trilinear import Shape
from devrf.rendering.output import RenderOutput
from devrf.scenes.scene import Scene


class TiNeuVox(DensityColorField):
    """(σ, c) = R(V(x + D(x, ω)), x, ω, d), ω = T(t): voxels at rest, networks that know the time.

    See docs/methods/tineuvox.md. Networks live in normalised space.

    Attributes:
        grid: V, over :attr:`grid_box`.
        time: T, from times (R, 1) to codes ω (R, 5C).
        deformation: D, from encoded positions and codes (S, ·) to displacements (S, 3).
        radiance: R.
        grid_box: the fields' box in normalised space.
    """

    name: ClassVar[str] = "tineuvox"
    losses: ClassVar[tuple[str, ...]] = ("render", "background_entropy", "sample_color")
    keeps_batches: ClassVar[bool] = True  # large steps need whole ones
    settings_class = TiNeuVoxSettings
    settings: TiNeuVoxSettings

    def __init__(self, settings: TiNeuVoxSettings | None = None) -> None:
        """Build grid and networks, of the published base's sizes if no settings are given."""
        s = settings or TiNeuVoxSettings()
        super().__init__(s)
        self.encode = SinusoidalEncoding(3, s.bands)
        self.grid = MultiDistanceGrid(s.channels, s.strides)
        encode_time = SinusoidalEncoding(1, s.time_bands)
        code = 5 * s.channels
        self.time = nn.Sequential(encode_time, *mlp(encode_time.size, s.width, 1, code))
        self.deformation = mlp(self.encode.size + code, s.width, 2, 3)
        self.radiance = RadianceNetwork(s, self.encode.size, code)
        if s.starts_still:
            still = [*self.deformation[-1].parameters(), self.radiance.trunk.weight[:, -code:]]
            for unmoved in still:
                nn.init.zeros_(unmoved)
        self.least_weight = s.weight_threshold
        self.density_shift = math.log(1 / (1 - s.alpha_init) - 1)
        self.place()

    def set_place(self, box: Box, space: Space, depths: tuple[float, float]) -> None:
        """Take box, space and depths; the grid spans the box."""
        super().set_place(box, space, depths)
        x, y, z = (edge / box.longest for edge in box.size)
        self.grid_box = Box((-x, -y, -z), (x, y, z))

    def setup(self, scene: Scene) -> None:
        """Take bounds, times and hulls; make the grid as small as it is before it grows."""
        super().setup(scene)
        self.grid.resize(self._shape_after(0))

    @property
    def resolution(self) -> tuple[int, ...]:
        """Grid points along x, y, z."""
        return self.grid.shape

    @property
    def most_bytes(self) -> int:
        """With a grid that has grown."""
        s, values = self.settings, self.grid.values
        grown = math.prod(self._shape_after(len(s.upsample_at))) * s.channels
        return super().most_bytes + (grown - values.numel()) * values.element_size()

    @property
    def grid_channels(self) -> Collection[int]:
        """Of V."""
        return (self.settings.channels,)

    def growths(self, total: int) -> Sequence[int]:
        """As the settings say."""
        return [round(share * total) for share in self.settings.upsample_at]

    def grow(self, count: int) -> None:
        """Resample the grid to N / 2^(growths left) points, if that is more than it has."""
        shape = self._shape_after(count)
        if math.prod(shape) > math.prod(self.grid.shape):
            self.grid.resize(shape)

    def _shape_after(self, count: int) -> Shape:
        remaining = len(self.settings.upsample_at) - count
        side = self.settings.side * self.space.side_factor / 2 ** (remaining / 3)
        return self.grid.fitting(self.grid_box, side)

    @property
    def base_voxel(self) -> float:
        """Edge of a voxel of the grown grid, in the fields' space: the unit of density."""
        return self.box.voxel_size(round((self.settings.side * self.space.side_factor) ** 3))

    @property
    def step_length(self) -> float:
        """So many voxels of the present grid, in the fields' space."""
        return self.settings.step * self.box.voxel_size(math.prod(self.grid.shape))

    def sigma(self, points: Tensor, time: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
        """σ (S,) and its hidden features.

        It is softplus(raw + log(1/(1 − α_init) − 1)) per :attr:`base_voxel`, in normalised units.
        """
        code = self.time(time[:, None])
        position = self.encode(points)
        features = self.grid(points + self._displacement(position, code, ray), self.grid_box)
        hidden = self.radiance.hidden(features, position, code, ray)
        density = nn.functional.softplus(self.radiance.density(hidden)[:, 0] + self.density_shift)
        return density * (self.placement.half_edge / self.base_voxel), hidden

    def _displacement(self, position: Tensor, code: Tensor, ray: Tensor) -> Tensor:
        """Δ (S, 3) of encoded points, each at the encoded time of its ray."""
        first, *further = self.deformation
        assert isinstance(first, nn.Linear)
        displacement = linear_by_ray(first, [position], code, ray)
        for layer in further:
            displacement = layer(displacement)
        return displacement

    def backward_warp(self, time: float) -> Callable[[Tensor], Tensor]:
        """x → x + Δ(x, t)."""

        def mapped(points: Tensor) -> Tensor:
            position = self.placement.normalised(points)
            code = self.time(position.new_full((1, 1), time))
            ray = torch.zeros_like(position[:, 0], dtype=torch.long)
            moved = position + self._displacement(self.encode(position), code, ray)
            return self.placement.fields(moved)

        return mapped

    def rgb(self, features: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3)."""
        return torch.sigmoid(self.radiance.color(features, viewdirs, ray))

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``; ``background_entropy`` of T_end; ``sample_color``, of each sample alone."""
        terms = super().loss_terms(output, batch, names) if "render" in names else {}
        if "background_entropy" in names:
            terms["background_entropy"] = background_entropy(output.transmittance)
        if "sample_color" in names:
            extras = output.extras
            terms["sample_color"] = per_sample_color(
                extras["weight"], extras["sample_color"], extras["ray"], batch.color
            )
        return terms

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """Voxels with their networks; the deformation; the time network of both."""
        return {
            "canonical": [*self.grid.parameters(), *self.radiance.parameters()],
            "deformation": self.deformation.parameters(),
            "time": self.time.parameters(),
        }

    def param_groups(self) -> list[dict[str, Any]]:
        """A group of the grid, whose untouched points keep their moments; the other parts."""
        s = self.settings
        values = self.grid.values
        rates = {"deformation": s.deformation_rate}
        groups: list[dict[str, Any]] = []
        for group in super().param_groups():
            name = group["name"]
            others = [parameter for parameter in group["params"] if parameter is not values]
            groups.append({"name": name, "params": others, "rate": rates.get(name, 1.0)})
        if values.requires_grad:
            grid = {"name": "grid", "params": [values], "rate": s.grid_rate, "skip_zero": True}
            groups.append({**grid, "smoothing": s.tv * max(self.grid.shape) / 128 / 6})
        return groups

"""D-NeRF (Pumarola et al., CVPR 2021): a radiance field at rest, and an MLP that leads to it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import ClassVar

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import constant
from devrf.methods.nerf.deformable import DeformableField
from devrf.methods.nerf.networks import SinusoidalEncoding, Trunk
from devrf.methods.nerf.settings import Bands, FieldSettings
from devrf.rendering.output import RenderOutput
from devrf.system.options import Count

# The last layer's weights begin in ±SMALL, so that the first displacements are next to zero.
SMALL = 1e-4


class TranslationField(nn.Module):
    """Δ(x, t) = D(γ(x), γ(t)), and exactly 0 at t = 0 (docs/methods/dnerf.md#deformation)."""

    def __init__(self, settings: DNeRFSettings) -> None:
        super().__init__()
        width = settings.deformation_width
        depth = settings.deformation_depth
        self.encode_position = SinusoidalEncoding(3, settings.bands)
        self.encode_time = SinusoidalEncoding(1, settings.time_bands)
        position = self.encode_position.size
        time = self.encode_time.size
        self.trunk = Trunk(position + time, width, depth, settings.skip, skipped=position)
        self.output = nn.Linear(width, 3)
        nn.init.uniform_(self.output.weight, -SMALL, SMALL)
        nn.init.zeros_(self.output.bias)

    def forward(self, points: Tensor, time: Tensor) -> Tensor:
        """Displacements (S, 3) to canonical space of points (S, 3) at times (S,) in [0, 1]."""
        moving = (time > 0).nonzero()[:, 0]
        moved = points.index_select(0, moving)
        when = time.index_select(0, moving)
        encoded = torch.cat([self.encode_position(moved), self.encode_time(when[:, None])], dim=-1)
        displacement = self.output(self.trunk(encoded))
        return torch.zeros_like(points).index_copy(0, moving, displacement.to(points.dtype))


@dataclass(frozen=True)
class DNeRFSettings(FieldSettings):
    """Sizes and sampling; the defaults are those of the release (docs/methods/dnerf.md).

    Attributes:
        deformation_width: units of each layer of the deformation.
        deformation_depth: layers of the deformation.
        time_bands: octaves of times: 10 in the release, 4 in the paper.
    """

    rehearsal: ClassVar = {
        **FieldSettings.rehearsal,
        "deformation_width": 64,
        "deformation_depth": 4,
    }

    deformation_width: Count = 256
    deformation_depth: Count = 8
    time_bands: Bands = 10


class DNeRF(DeformableField):
    """(σ, c) = T(x + Δ(x, t), d), with Δ = 0 at t = 0."""

    name: ClassVar[str] = "dnerf"
    losses: ClassVar[tuple[str, ...]] = ("render", "temporal")
    settings_class = DNeRFSettings

    def __init__(self, settings: DNeRFSettings | None = None) -> None:
        """Build the networks, as published if no settings are given."""
        settings = settings or DNeRFSettings()
        super().__init__(settings)
        self.deformation = TranslationField(settings)

    def deform(self, points: Tensor, time: Tensor) -> tuple[Tensor, None]:
        """x + Δ(x, t)."""
        return points + self.deformation(points, time), None

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance fields and the deformation."""
        return {**self.radiance_parts(), "deformation": self.deformation.parameters()}

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``; ``temporal``: Σ |Δ(x, t) − Δ(x, t′)|², t′ towards a neighbouring frame."""
        terms = super().loss_terms(output, batch, names)
        if "temporal" in names:
            points = output.extras["points"].detach()
            time = output.extras["time"]
            side = 2 * torch.rand_like(time) - 1
            beside = self.clock.frames_of(time) + side.sign().long()
            times = constant(self.clock.times, time.dtype, time.device)
            neighbour = times[beside.clamp(0, len(self.clock) - 1)]
            other = time + side.abs() * (neighbour - time)
            change = self.deformation(points, time) - self.deformation(points, other)
            terms["temporal"] = change.square().sum()
        return terms

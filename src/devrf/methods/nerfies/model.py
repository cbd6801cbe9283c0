"""Nerfies (Park et al., ICCV 2021): a radiance field, and rigid motions that lead to it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, ClassVar, Literal

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.engine.protocol import ProtocolStage
from devrf.geometry.poses import rigid_motion
from devrf.methods.nerf.deformable import DeformableField
from devrf.methods.nerf.networks import (
    SinusoidalEncoding,
    TimeCodes,
    Trunk,
    initialise,
    octave_window,
)
from devrf.methods.nerf.settings import Bands, FieldSettings, Initialisation, Samples
from devrf.methods.nerfies.elastic import SCALE, drawn, jacobians, robust, strain
from devrf.rendering.output import RenderOutput
from devrf.system.options import Count, Share, Whole

# The heads' weights begin in [0, SMALL), so that the first motions are next to none.
SMALL = 1e-4


class RigidWarp(nn.Module):
    """x′ = e^{[r]} x + G v with (r, v) = W(γ_α(x), ω) (docs/methods/nerfies.md#warp).

    Attributes:
        opened: () α, the octaves of γ that the window lets through; stored with the weights.
    """

    opened: Tensor

    def __init__(self, settings: NerfiesSettings) -> None:
        super().__init__()
        s = settings
        width = settings.warp_width
        self.bands = s.warp_bands
        self.encode = SinusoidalEncoding(3, s.warp_bands)
        self.trunk = Trunk(self.encode.size + s.code, width, s.warp_depth, s.warp_skip)
        self.rotation = nn.Linear(width, 3)
        self.velocity = nn.Linear(width, 3)
        self.register_buffer("opened", torch.zeros(()))
        initialise(self.trunk, "glorot")
        for head in (self.rotation, self.velocity):
            nn.init.uniform_(head.weight, 0, SMALL)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """Deformed points (S, 3) of normalised space; ``code`` (S, code) is of their times."""
        window = octave_window(self.opened, self.bands)
        x = self.trunk(torch.cat([self.encode(points, window), code], dim=-1))
        rotation = self.rotation(x)
        velocity = self.velocity(x)
        return rigid_motion(points, rotation.to(points.dtype), velocity.to(points.dtype))


@dataclass(frozen=True)
class NerfiesSettings(FieldSettings):
    """Sizes and sampling; the defaults are the published ones (docs/methods/nerfies.md).

    Attributes:
        code: length of a frame's code.
        warp_width: units of each layer of the warp.
        warp_depth: layers of the warp.
        warp_skip: the layer that the warp's input enters again; None: the middle one.
        warp_bands: octaves of the warp's positions.
        window: share of a stage during which these octaves are opened one after another.
        elastic: ``drawn``, one sample of a ray by weight; ``full``, the sum over all samples.
        elastic_rays: rays of a batch that the elastic term looks at; 0: all.
    """

    rehearsal: ClassVar = {**FieldSettings.rehearsal, "warp_width": 64, "warp_depth": 4}

    skip: int | None = 4
    bands: Bands = 8
    initialisation: Initialisation = "glorot"
    coarse: Samples = 128
    fine: Samples = 128
    separate_coarse: bool = True
    code: Count = 8
    warp_width: Count = 128
    warp_depth: Count = 6
    warp_skip: int | None = 4
    warp_bands: Bands = 6
    window: Share = 0.32
    elastic: Literal["drawn", "full"] = "drawn"
    elastic_rays: Whole = 0


class Nerfies(DeformableField):
    """(σ, c) = T(W(x, ω_t), d).

    The warp is free at time 0, as published, unless a stage has learned T from the static images
    alone: T then is the scene at time 0, and the warp leaves that as it is.

    Attributes:
        rest_is_canonical: whether nothing is warped at time 0.
    """

    name: ClassVar[str] = "nerfies"
    losses: ClassVar[tuple[str, ...]] = ("render", "elastic")
    settings_class: ClassVar[type[FieldSettings]] = NerfiesSettings
    checkpointed_attributes: ClassVar[Mapping[str, Any]] = {"rest_is_canonical": bool}
    settings: NerfiesSettings

    def __init__(self, settings: NerfiesSettings | None = None, ambient: int = 0) -> None:
        """Build the networks.

        Args:
            settings: sizes and sampling; None: as published.
            ambient: length of T's input beside the position.
        """
        settings = settings or NerfiesSettings()
        super().__init__(settings, ambient)
        self.rest_is_canonical = False
        self.warp = RigidWarp(settings)

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times, and draw a code for each."""
        super().set_times(times)
        self.codes = TimeCodes(times, self.settings.code).to(self.device)

    def begin_stage(self, stage: ProtocolStage) -> None:
        """Take the canonical state from the static images, if a stage learns from them alone."""
        super().begin_stage(stage)
        self.rest_is_canonical |= stage.capture == "static"

    def milestones(self, total: int) -> dict[str, int]:
        """The iteration at which all of the warp's octaves are open."""
        opened = round(self.settings.window * total)
        return {**super().milestones(total), "octaves of the warp open": opened}

    def on_iteration(self, step: int, total: int) -> None:
        """Open the warp's octaves: α grows evenly from 0. Look where the field is empty."""
        super().on_iteration(step, total)
        share = self.settings.window * total
        opened = min(step / share, 1.0) if share else 1.0
        self.warp.opened.fill_(opened * self.settings.warp_bands)

    def deform(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None]:
        """Deformed points, and T's further input; nothing moves at a canonical rest state."""
        if not self.rest_is_canonical:
            return self.bend(points, time)
        moving = (time > 0).nonzero()[:, 0]
        bent, ambient = self.bend(points.index_select(0, moving), time.index_select(0, moving))
        if ambient is not None:
            nothing = ambient.new_zeros(len(points), ambient.shape[1])
            ambient = nothing.index_copy(0, moving, ambient)
        return points.index_copy(0, moving, bent), ambient

    def bend(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None]:
        """As :meth:`deform`, but time 0 is like any other time."""
        return self.warp(points, self.codes(time)), None

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The radiance fields, the warp, and the frames' codes."""
        deformation = {"warp": self.warp.parameters(), "codes": self.codes.parameters()}
        return {**self.radiance_parts(), **deformation}

    def loss_terms(
        self, output: RenderOutput, batch: RayBatch, names: Collection[str]
    ) -> dict[str, Tensor]:
        """``render``; ``elastic``: the mean over rays of Σ_i w_i · c ρ(Σ_j log² s_j; c).

        s are the singular values of ∂x′/∂x at sample i, and c = 0.03. The factor c before ρ is
        that of the released code; w has no gradient (docs/methods/nerfies.md#elastic).
        """
        terms = super().loss_terms(output, batch, names)
        if "elastic" in names:
            terms["elastic"] = self._elastic(output, len(batch.time))
        return terms

    def _elastic(self, output: RenderOutput, rays: int) -> Tensor:
        """The term over the coarse samples if these have a field of their own, as published."""
        prefix = "coarse_" if "coarse_points" in output.extras else ""
        points = output.extras[f"{prefix}points"].detach()
        time = output.extras[f"{prefix}time"].detach()
        weight = output.extras[f"{prefix}weight"].detach()
        ray = output.extras[f"{prefix}ray"].detach()
        count = min(self.settings.elastic_rays or rays, rays)
        subset = torch.randperm(rays, device=ray.device)[:count]
        if self.settings.elastic == "drawn":
            sample, mass = drawn(weight, ray, subset, rays)
        else:
            sample = torch.isin(ray, subset).nonzero()[:, 0]
            mass = weight[sample]
        if self.rest_is_canonical:
            moving = (time[sample] > 0).nonzero()[:, 0]
            sample = sample[moving]
            mass = mass[moving]
        code = self.codes(time[sample])
        stretch = strain(jacobians(lambda x: self.warp(x, code), points[sample]))
        return (mass * SCALE * robust(stretch, SCALE)).sum() / count

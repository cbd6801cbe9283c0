"""HyperNeRF (Park et al., SIGGRAPH Asia 2021): Nerfies in slices of a larger space."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from devrf.engine.protocol import ProtocolStage
from devrf.methods.nerf.networks import (
    SinusoidalEncoding,
    TimeCodes,
    Trunk,
    initialise,
    octave_window,
)
from devrf.methods.nerf.settings import Bands, FieldSettings
from devrf.methods.nerfies.model import Nerfies, NerfiesSettings
from devrf.system.options import Count, Share

# Standard deviation of the last layer's first weights: all of space begins at w = 0, nearly.
SMALL = 1e-5


class SlicingSurface(nn.Module):
    """w = H(γ(x), ω): a deformable surface, as the ambient coordinate differs from point to point.

    See docs/methods/hypernerf.md#slicing.
    """

    def __init__(self, settings: HyperNeRFSettings) -> None:
        super().__init__()
        s = settings
        width = settings.slicing_width
        self.encode = SinusoidalEncoding(3, s.slicing_bands, identity=False)
        self.trunk = Trunk(self.encode.size + s.code, width, s.slicing_depth, s.slicing_skip)
        self.output = nn.Linear(width, s.ambient)
        initialise(self.trunk, "glorot")
        nn.init.normal_(self.output.weight, std=SMALL)
        nn.init.zeros_(self.output.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """w (S, ambient) at points (S, 3) in normalised space; their times' codes (S, code)."""
        w: Tensor = self.output(self.trunk(torch.cat([self.encode(points), code], dim=-1)))
        return w


@dataclass(frozen=True)
class HyperNeRFSettings(NerfiesSettings):
    """Sizes and sampling; the defaults are the published ones (docs/methods/hypernerf.md).

    Attributes:
        slicing: ``surface``, w differs from point to point (the paper's DS); ``plane``, w is one
            for each frame (AP).
        ambient: length of w.
        ambient_bands: octaves of w; w does not enter by itself.
        ambient_delay: share of a stage before ambient space is opened.
        ambient_window: share of a stage during which it is then opened.
        slicing_width: units of each layer of the surface.
        slicing_depth: layers of the surface.
        slicing_skip: the layer that the surface's input enters again; None: the middle one.
        slicing_bands: octaves of the surface's positions.
    """

    slicing: Literal["surface", "plane"] = "surface"
    ambient: Count = 2
    ambient_bands: Annotated[Bands, Ge(1)] = 1
    ambient_delay: Share = 0.004
    ambient_window: Share = 0.04
    slicing_width: Count = 64
    slicing_depth: Count = 6
    slicing_skip: int | None = 4
    slicing_bands: Bands = 6

    def __post_init__(self) -> None:
        super().__post_init__()
        delay = self.ambient_delay
        together = delay + self.ambient_window <= 1
        self.check("ambient_window", together, f"at most 1 with ambient_delay ({delay})")


class HyperNeRF(Nerfies):
    """(σ, c) = T(W(x, ω_t), γ_β(w), d) with w = H(x, ω_t); β = 0 is Nerfies exactly.

    Attributes:
        opened: () β, the octaves of w that enter T; stored with the weights.
        slicing: H; or a w for each frame.
    """

    name: ClassVar[str] = "hypernerf"
    settings_class: ClassVar[type[FieldSettings]] = HyperNeRFSettings
    settings: HyperNeRFSettings
    opened: Tensor
    slicing: SlicingSurface | TimeCodes

    def __init__(self, settings: HyperNeRFSettings | None = None) -> None:
        """Build the networks, as published if no settings are given."""
        s = settings or HyperNeRFSettings()
        encode = SinusoidalEncoding(s.ambient, s.ambient_bands, identity=False)
        super().__init__(s, encode.size)
        self.encode = encode
        self.register_buffer("opened", torch.zeros(()))
        self._shut = False
        if s.slicing == "surface":
            self.slicing = SlicingSurface(s)

    def set_times(self, times: tuple[float, ...]) -> None:
        """Take the frames' times, and draw a code for each, and a w if that is the frame's."""
        super().set_times(times)
        if self.settings.slicing == "plane":
            self.slicing = TimeCodes(times, self.settings.ambient).to(self.device)

    def begin_stage(self, stage: ProtocolStage) -> None:
        """Static images alone do not open ambient space."""
        super().begin_stage(stage)
        self._shut = stage.capture == "static"

    def milestones(self, total: int) -> dict[str, int]:
        """The iteration at which ambient space is open, if it opens."""
        s = self.settings
        opened = round((s.ambient_delay + s.ambient_window) * total)
        further = {} if self._shut else {"ambient space open": opened}
        return {**super().milestones(total), **further}

    def on_iteration(self, step: int, total: int) -> None:
        """Open the warp's octaves, and those of w: β grows evenly from 0 after a delay."""
        super().on_iteration(step, total)
        s = self.settings
        since = step - s.ambient_delay * total
        share = s.ambient_window * total
        opened = min(max(since, 0.0) / share, 1.0) if share else float(since >= 0)
        self.opened.fill_(0.0 if self._shut else opened * s.ambient_bands)

    def bend(self, points: Tensor, time: Tensor) -> tuple[Tensor, Tensor | None]:
        """W(x, ω) and γ_β(w)."""
        code = self.codes(time)
        w = self.slicing(time) if self.settings.slicing == "plane" else self.slicing(points, code)
        window = octave_window(self.opened, self.settings.ambient_bands)
        return self.warp(points, code), self.encode(w, window)

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """Nerfies' parts, the slicing network, and, apart from T, the weights by which w enters."""
        return {**super().parts(), "ambient": self.slicing.parameters()}

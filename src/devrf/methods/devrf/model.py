"""DeVRF's model: a canonical voxel field, its occupancy, and how it deforms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from devrf.data.batch import RayBatch
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.methods.base import DynamicModel
from devrf.methods.devrf.appearance import AppearanceField, ColorResidual
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.compact_state import compact_state, expanded_state
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformed_occupancy import deformed_occupancy
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.static_shape.viewing import ListRenderer
from devrf.methods.devrf.surface import CanonicalSurface
from devrf.methods.devrf.view import DeVRFView
from devrf.methods.devrf.volume_rendering import Warp, render
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import RenderOutput


class DeVRFModel(DynamicModel):
    """A scene, to be rendered from any view at any time.

    Attributes:
        architecture: sizes of the canonical field.
        canonical: what the scene looks like at rest.
        occupancy: where something is at rest.
        deformation: V_motion; None shows the rest state at every time.
        settings: how rays are sampled.
        space: the space that the fields live in.
        appearance: how colours change over time; None: they do not.
    """

    name: ClassVar[str] = "devrf"

    def __init__(
        self,
        architecture: Architecture,
        canonical: CanonicalField,
        occupancy: Occupancy,
        settings: RenderSettings,
        deformation: DeformationField | None = None,
        space: Space = WORLD,
        appearance: AppearanceField | None = None,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.canonical = canonical
        self.occupancy = occupancy
        self.settings = settings
        self.deformation = deformation
        self.appearance = appearance
        self.space = space
        self._lists: dict[bool, ListRenderer] = {}

    @property
    def box(self) -> Box:  # type: ignore[override]
        """Where the fields live."""
        return self.canonical.box

    @property
    def depth_limits(self) -> tuple[float, float]:  # type: ignore[override]
        """Near and far of the sampling."""
        return self.settings.near, self.settings.far

    def config(self) -> dict[str, Any]:
        """Sizes, sampling, space, and which fields there are."""
        return {
            "architecture": asdict(self.architecture),
            "settings": asdict(self.settings),
            "space": space_config(self.space),
            "radiance": self.canonical.has_network,
            "deforms": self.moves,
            "changes_color": self.appearance is not None,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> DeVRFModel:
        """Fields of a few voxels; the stored state gives them their shapes."""
        box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        build = Architecture(**config["architecture"])
        # A stage that was stopped in its search has no colour network yet.
        radiance, clock = config["radiance"], FrameClock((0.0, 1.0))
        return cls(
            build,
            build.radiance_field(box, 8, 8) if radiance else build.search_field(box, 8),
            Occupancy.full((2, 2, 2), box),
            RenderSettings(**config["settings"]),
            DeformationField(box, clock, voxels=8) if config["deforms"] else None,
            space_from(config["space"]),
            AppearanceField(box, clock, voxels=8) if config.get("changes_color") else None,
        )

    def forward(self, batch: RayBatch) -> RenderOutput:
        """Render rays, those of each distinct time through that time's warp."""
        rays = len(batch.rays)
        background = batch.background.expand(rays, 3)
        color = torch.zeros_like(batch.color)
        depth, transmittance = color.new_zeros(rays), color.new_zeros(rays)
        for time in torch.unique(batch.time).tolist():
            place = (batch.time == time).nonzero()[:, 0]
            seen = render(
                batch.rays[place],
                self.canonical,
                self.occupancy_at(time),
                self.settings,
                background[place],
                self.warp(time),
                appearance=self.residual(time),
            )
            color = color.index_copy(0, place, seen.color)
            depth = depth.index_copy(0, place, seen.depth)
            transmittance = transmittance.index_copy(0, place, seen.transmittance)
        return RenderOutput(color=color, depth=depth, transmittance=transmittance)

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        """The canonical field; frames of the deformation are learned by ``DeformationStage``."""
        return {"canonical": self.canonical.parameters()}

    def warp(self, time: float) -> Warp | None:
        """x → x + Δ_b(x, t), points (M, 3) at ``time`` → canonical space; None is the identity."""
        deformation = self.deformation
        if deformation is None or deformation.clock.at(time).after == 0:
            return None
        return deformation.warp_at(time)

    def residual(self, time: float) -> ColorResidual | None:
        """q → A_t(q) at ``time``; None where colours are those of the canonical field."""
        return None if self.appearance is None else self.appearance.at(time)

    def occupancy_at(self, time: float) -> Occupancy:
        """Where something is at ``time`` in [0, 1]."""
        warp = self.warp(time)
        if warp is None:
            return self.occupancy
        return deformed_occupancy(self.occupancy, self.canonical, warp)

    def at(self, time: float, *, half: bool = False) -> DeVRFView:
        """The scene at ``time``: its occupancy and its displacements, ready."""
        lists, present = self._lists.get(half), (self.canonical, self.settings)
        if lists is None or (lists.field, lists.settings) != present:
            lists = self._lists[half] = ListRenderer(*present, half=half)
        return DeVRFView(self.occupancy, self.deformation, lists, self.space, time, self.appearance)

    def surface(self) -> CanonicalSurface:
        """The canonical field."""
        return CanonicalSurface(self.canonical, self.occupancy)

    def forward_map(self, time: float) -> Callable[[Tensor], Tensor]:
        """q → q + Δ_f(q, t) (docs/method.md#warp)."""
        if self.deformation is None:
            return lambda points: points
        return torch.no_grad()(partial(self.deformation.unwarp, time=time))

    def to_view(self, device: torch.device) -> Self:
        """The model on ``device``; displacements follow when their frame is looked at."""
        if self.deformation is not None and not self.deformation.to_canonical.is_cuda:
            self.deformation.frames.on_host = True
        return self.to(device)

    @property
    def device(self) -> torch.device:
        """Where the canonical field is."""
        return self.canonical.density.values.device

    @property
    def moves(self) -> bool:
        """Whether there is a deformation field."""
        return self.deformation is not None

    @property
    def size(self) -> int:
        """Values of all fields."""
        motion, appearance = self.deformation, self.appearance
        frames = [] if motion is None else [motion.to_canonical, motion.to_time]
        frames += [] if appearance is None else [appearance.values]
        return super().size + sum(tensor.numel() for tensor in frames)

    def stored_state(self) -> dict[str, Any]:
        """The state with packed grids (``compact_state``)."""
        fields = self.occupancy, self.canonical, self.deformation, self.occupancy_at
        endless = not self.space.is_linear
        return compact_state(self.state_dict(), *fields, self.appearance, endless=endless)

    def load_stored_state(self, state: Mapping[str, Any]) -> None:
        """Take a compact or a full state."""
        self.load_state_dict(expanded_state(dict(state)))

"""Settings of both stages; the defaults are the paper's for inward-facing scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge, Lt
from pydantic.dataclasses import dataclass

from devrf.rendering.sampling import RaysPerPixel, Step
from devrf.system.options import Count, NotNegative, Options, Positive

Opacity = Annotated[float, Ge(0), Lt(1)]

SEARCH_LOSS = {"render": 1.0, "per_sample_color": 0.1, "entropy": 0.01}
FINE_LOSS = {
    "render": 1.0,
    "per_sample_color": 0.01,
    "entropy": 0.001,
    "alpha_mask": 0.0,
    "tv": 0.0,
}
DEFORMATION_LOSS = {
    "render": 1.0,
    "cycle": 100.0,
    "flow": 0.005,
    "tv": 1.0,
    "per_sample_color": 0.1,
    "entropy": 0.01,
    "alpha_mask": 0.0,
}


@dataclass(frozen=True)
class CanonicalRates(Options):
    """Base learning rates of the canonical field's parts, by name (docs/method.md#optimiser)."""

    key: ClassVar[str] = "schedule.rates"

    density: NotNegative = 0.1
    color: NotNegative = 0.1
    decoder: NotNegative = 1e-3


@dataclass(frozen=True)
class Sampling(Options):
    """Settings of the sampling of rays (docs/method.md#rays).

    Attributes:
        step: distance between samples in voxels.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, get no colour.
        search_alpha_threshold: the same in the geometry search, which begins almost transparent;
            there it empties cells, too.
        occupancy_threshold: opacity of a step up to which a cell counts as empty.
        rays_per_pixel: of a batch; a pixel's colour is their mean.
    """

    key: ClassVar[str] = "sampling"

    step: Step = 0.5
    alpha_threshold: Opacity = 1e-4
    search_alpha_threshold: Opacity = 1e-7
    occupancy_threshold: Opacity = 1e-3
    rays_per_pixel: RaysPerPixel = 1


@dataclass(frozen=True)
class VisitSettings(Options):
    """Settings of the deformation stage, beside its schedule (docs/method.md#departures).

    Attributes:
        learning_rate: base rate, in ``unit`` per step: a voxel moves by no more.
        unit: ``world`` for world units; ``box`` for the longest edge of the fields' box, by which
            ``cycle`` and ``tv`` of the loss are measured then, too.
        views: a batch shows ``one`` of the frame's views, in turn, or ``all``.
        pixels: ``all``, or ``occupied``: of the alpha mask, and where rays hit the present field.
        epochs: batches are smaller if a visit would show each pixel more often.
        occupancy_every: iterations between updates of the frame's occupancy.
        store: the memory of the frames while one is learned; ``auto``: the device's if they fit.
        store_half: whether they are kept in half precision; ``auto``: on a GPU.
        adam_state: ``fresh`` at each visit, or above the coarsest level ``carried`` over.
    """

    key: ClassVar[str] = "schedule.visit"

    learning_rate: NotNegative = 1e-3
    unit: Literal["world", "box"] = "world"
    views: Literal["one", "all"] = "one"
    pixels: Literal["all", "occupied"] = "all"
    epochs: Positive | None = None
    occupancy_every: Count = 25
    adam_state: Literal["fresh", "carried"] = "fresh"
    store: Literal["auto", "device", "host"] = "auto"
    store_half: bool | Literal["auto"] = "auto"

    def scaled(self, factor: float) -> VisitSettings:
        """The settings for ``factor`` times the iterations, in which voxels move as far."""
        every = max(1, round(self.occupancy_every * factor))
        return replace(self, learning_rate=self.learning_rate / factor, occupancy_every=every)

    def stored_half(self, device: torch.device) -> bool:
        """Whether frames are kept in half precision while a stage learns on ``device``."""
        return device.type == "cuda" if self.store_half == "auto" else self.store_half

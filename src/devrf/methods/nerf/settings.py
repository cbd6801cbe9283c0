"""Sizes and sampling of radiance fields that are networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from annotated_types import Ge, Le
from pydantic.dataclasses import dataclass

from devrf.errors import expect
from devrf.system.options import Options, Positive, Several, Share

Initialisation = Literal["uniform", "glorot"]

# Samples of a ray; octaves of an encoding.
Samples = Annotated[int, Ge(2), Le(1024)]
Bands = Annotated[int, Ge(0), Le(32)]


@dataclass(frozen=True)
class MethodSettings(Options):
    """Sizes and sampling of a method.

    Attributes:
        rehearsal: the largest that settings are in a rehearsal, by name.
    """

    key: ClassVar[str] = "ray_stage.model.settings"
    rehearsal: ClassVar[Mapping[str, int]] = {}

    def rehearsed(self, factor: float) -> Self:
        """The settings at sizes for seconds on a CPU, in ``factor`` times the iterations."""
        smaller = {name: min(getattr(self, name), most) for name, most in self.rehearsal.items()}
        return replace(self, **smaller)

    def check(self, name: str, holds: bool, expected: str) -> None:
        """Refuse by a DevrfError the setting ``name`` unless a condition ``holds``."""
        expect(holds, f"{self.key}.{name}", expected, getattr(self, name))


@dataclass(frozen=True)
class OccupancySettings(MethodSettings):
    """Settings of the skipping of empty space.

    Attributes:
        occupancy_side: the masks have about side³ cells.
        hull: whether the masks are the visual hulls of each frame's alpha masks, if there are any;
            the published methods never had these.
        empty_from: without such hulls, space that the fields leave empty at all times is left out
            after this share of a stage; None: never.
    """

    rehearsal: ClassVar = {"occupancy_side": 32}

    occupancy_side: Several = 128
    hull: bool = True
    empty_from: Share | None = 0.25


@dataclass(frozen=True)
class PlacedSettings(OccupancySettings):
    """Common settings of D-NeRF, Nerfies, HyperNeRF and NSFF.

    Attributes:
        width: units of each layer of a radiance field.
        depth: layers of a radiance field.
        skip: the layer, counted from 0, that its input enters again; None: the middle one.
        bands: octaves of positions.
        direction_bands: octaves of viewing directions.
        density_scale: density of a softplus of 1, per half of the box's longest edge.
        initialisation: of all layers: ``uniform`` (PyTorch's) or ``glorot``.
        steps: samples along the box's diagonal (occupancy).
    """

    # Such networks learn from the first iteration on.
    rehearsal: ClassVar = {**OccupancySettings.rehearsal, "width": 64, "depth": 4, "steps": 64}

    width: Several = 256
    depth: Several = 8
    skip: int | None = 5
    bands: Bands = 10
    direction_bands: Bands = 4
    density_scale: Positive = 10.0
    initialisation: Initialisation = "uniform"
    steps: Samples = 128


@dataclass(frozen=True)
class FieldSettings(PlacedSettings):
    """Common settings of D-NeRF, Nerfies and HyperNeRF.

    Attributes:
        sampling: ``hierarchical`` (coarse, then fine by weight) or ``occupancy`` (even steps where
            something may be).
        coarse: samples a ray before weights are known (hierarchical).
        fine: samples a ray that are drawn by weight (hierarchical).
        separate_coarse: whether coarse samples have a radiance field of their own, learned with the
            other one (hierarchical).
    """

    rehearsal: ClassVar = {**PlacedSettings.rehearsal, "coarse": 24, "fine": 24}

    sampling: Literal["hierarchical", "occupancy"] = "hierarchical"
    coarse: Samples = 64
    fine: Samples = 128
    separate_coarse: bool = False

    def __post_init__(self) -> None:
        possible = self.sampling == "hierarchical" or not self.separate_coarse
        self.check(
            "separate_coarse", possible, "false, as sampling=occupancy has no coarse samples"
        )

"""Sizes and sampling of radiance fields that are networks."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from annotated_types import Ge, Le
from pydantic.dataclasses import dataclass

from devrf.errors import expect
from devrf.system.options import Options, Several, Share

Initialisation = Literal["uniform", "glorot"]

# Samples of a ray; octaves of an encoding.
Samples = Annotated[int, Ge(2), Le(1024)]
Bands = Annotated[int, Ge(0), Le(32)]


@dataclass(frozen=True)
class MethodSettings(Options):
    """Sizes and sampling of a method."""

    key: ClassVar[str] = "ray_stage.model.settings"

    def rehearsed(self, factor: float) -> Self:
        """The settings at sizes for seconds on a CPU, in ``factor`` times the iterations."""
        return self

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

    occupancy_side: Several = 128
    hull: bool = True
    empty_from: Share | None = 0.25

    def rehearsed(self, factor: float) -> Self:
        """Coarser masks."""
        return replace(super().rehearsed(factor), occupancy_side=min(self.occupancy_side, 32))


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

    width: Several = 256
    depth: Several = 8
    skip: int | None = 5
    bands: Bands = 10
    direction_bands: Bands = 4
    density_scale: float = 10.0
    initialisation: Initialisation = "uniform"
    steps: Samples = 128

    def rehearsed(self, factor: float) -> Self:
        """Narrow networks of few layers, which learn from the first iteration on; few samples."""
        return replace(
            super().rehearsed(factor),
            width=min(self.width, 64),
            depth=min(self.depth, 4),
            skip=None if self.depth > 4 else self.skip,
            steps=min(self.steps, 64),
        )


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

    sampling: Literal["hierarchical", "occupancy"] = "hierarchical"
    coarse: Samples = 64
    fine: Samples = 128
    separate_coarse: bool = False

    def rehearsed(self, factor: float) -> Self:
        """Few samples."""
        smaller = super().rehearsed(factor)
        return replace(smaller, coarse=min(self.coarse, 24), fine=min(self.fine, 24))

    def __post_init__(self) -> None:
        possible = self.sampling == "hierarchical" or not self.separate_coarse
        self.check(
            "separate_coarse", possible, "false, as sampling=occupancy has no coarse samples"
        )

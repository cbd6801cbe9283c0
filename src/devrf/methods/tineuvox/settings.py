"""Sizes and sampling of TiNeuVox."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar

from annotated_types import Gt, Lt, MinLen
from pydantic.dataclasses import dataclass

from devrf.methods.nerf.settings import Bands, OccupancySettings
from devrf.rendering.sampling import Step
from devrf.system.options import Count, NotNegative, Positive, Several, Share


@dataclass(frozen=True)
class TiNeuVoxSettings(OccupancySettings):
    """Sizes and sampling; the defaults are those of the published base (docs/methods/tineuvox.md).

    Attributes:
        side: the grid has about side³ points in the end.
        channels: numbers of a grid point.
        strides: of the grids that are looked up, in points of the finest; the largest is a multiple
            of each.
        upsample_at: shares of a stage after which the number of grid points doubles.
        width: units of each layer.
        bands: octaves of positions.
        direction_bands: octaves of viewing directions.
        time_bands: octaves of times.
        feature_bands: octaves of interpolated features.
        alpha_init: opacity of a voxel of the grown grid in an untrained field.
        step: distance between samples, in voxels of the present grid.
        weight_threshold: samples with a lower weight are not coloured.
        grid_rate: factor of the learning rate of the grid.
        deformation_rate: the same of the deformation network.
        starts_still: displacements begin at 0, and so does what the time changes in density and
            colour: the first state that is learned is at rest.
        tv: weight of the grid's total variation over the rays of a batch.
    """

    rehearsal: ClassVar = {**OccupancySettings.rehearsal, "side": 32, "width": 64}
    sampling: ClassVar[str] = "occupancy"

    hull: bool = False
    empty_from: Share | None = None
    side: Several = 160
    channels: Count = 6
    strides: Annotated[Sequence[Count], MinLen(1)] = (1, 2, 4)
    upsample_at: Sequence[Share] = (0.1, 0.2, 0.3)
    width: Several = 256
    bands: Bands = 10
    direction_bands: Bands = 4
    time_bands: Bands = 8
    feature_bands: Bands = 2
    alpha_init: Annotated[float, Gt(0), Lt(1)] = 1e-3
    step: Step = 0.5
    weight_threshold: NotNegative = 1e-4
    grid_rate: Positive = 100.0
    deformation_rate: Positive = 0.75
    starts_still: bool = False
    tv: NotNegative = 0.0

    def __post_init__(self) -> None:
        fit = not any(max(self.strides) % stride for stride in self.strides)
        self.check("strides", fit, "numbers that divide the largest")
        shares = [0.0, *self.upsample_at, 1.0]
        self.check("upsample_at", shares == sorted(shares), "ascending shares from 0 to 1")

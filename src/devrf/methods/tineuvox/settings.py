"""Sizes and sampling of TiNeuVox."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from devrf.methods.nerf.settings import OccupancySettings
from devrf.rendering.sampling import FINEST


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
        feature_bands: octaves of what is looked up.
        alpha_init: opacity of a voxel of the grown grid in an untrained field.
        step: distance between samples, in voxels of the present grid.
        weight_threshold: samples with a lower weight are not coloured.
        grid_rate: factor of the learning rate of the grid.
        motion_rate: the same of the networks of time and displacement.
        starts_still: displacements begin at 0, and so does what the time changes in density and
            colour: what is learned first is at rest.
        tv: weight of the grid's total variation over the rays of a batch.
    """

    sampling: ClassVar[str] = "occupancy"

    hull: bool = False
    empty_from: float | None = None
    side: int = 160
    channels: int = 6
    strides: Sequence[int] = (1, 2, 4)
    upsample_at: Sequence[float] = (0.1, 0.2, 0.3)
    width: int = 256
    bands: int = 10
    direction_bands: int = 4
    time_bands: int = 8
    feature_bands: int = 2
    alpha_init: float = 1e-3
    step: float = 0.5
    weight_threshold: float = 1e-4
    grid_rate: float = 100.0
    motion_rate: float = 0.75
    starts_still: bool = False
    tv: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(2, "side", "width")
        self.check_least(1, "channels")
        self.check_least(0, "weight_threshold", "tv")
        self.check("alpha_init", 0 < self.alpha_init < 1, "between 0 and 1")
        self.check("step", self.step >= FINEST, f"at least {FINEST}")
        for name in ("grid_rate", "motion_rate"):
            self.check(name, getattr(self, name) > 0, "more than 0")
        strides = self.strides
        fit = bool(strides) and min(strides) >= 1 and not any(max(strides) % s for s in strides)
        self.check("strides", fit, "numbers above 0 that divide the largest")
        shares = [0.0, *self.upsample_at, 1.0]
        self.check("upsample_at", shares == sorted(shares), "ascending shares from 0 to 1")

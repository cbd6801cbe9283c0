"""Sizes and sampling of K-Planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from annotated_types import Ge, Le, MinLen
from pydantic.dataclasses import dataclass

from devrf.methods.nerf.settings import OccupancySettings, Samples
from devrf.system.options import Count, Several, Share

Pairing = Literal["product", "hexplane"]
HIGHEST_DEGREE = 3  # of spherical harmonics


@dataclass(frozen=True)
class KPlanesSettings(OccupancySettings):
    """Sizes and sampling; the defaults are the published ones (docs/methods/kplanes.md).

    Attributes:
        resolution: points along x, y and z of the coarsest planes.
        scales: factors of it, a set of planes each.
        time_resolution: points along time, at all scales; None: half the frames.
        channels: numbers of a point.
        pairing: of the features of the six planes: ``product``, or as in ``hexplane``.
        decoder: ``hybrid`` (small networks) or ``explicit`` (linear, in a basis for a direction).
        width: units of the hybrid decoder's layers.
        harmonics: highest degree of its spherical harmonics of the direction; 0: colours are the
            same from all sides, since few fixed cameras cannot tell them from motion.
        basis_width, basis_depth: units and number of the layers that give the basis (explicit).
        sampling: ``occupancy`` (even steps where something may be) or ``proposals`` (as published).
        steps: samples along the box's diagonal (occupancy).
        samples: of a ray in the end (proposals).
        proposal_samples, proposal_resolutions: of a ray and of the planes, of each round before.
        proposal_channels: numbers of a point of these planes.
        annealing: iterations in which the weights that samples are drawn by are sharpened.
        teaching: iterations in which proposals come to learn ever less often.
    """

    rehearsal: ClassVar = {
        **OccupancySettings.rehearsal,
        "resolution": 12,
        "channels": 8,
        "steps": 64,
        "samples": 24,
    }

    hull: bool = False
    empty_from: Share | None = 0.05
    resolution: Several = 64
    scales: Annotated[Sequence[Count], MinLen(1)] = (1, 2, 4, 8)
    time_resolution: Several | None = None
    channels: Count = 32
    pairing: Pairing = "product"
    decoder: Literal["hybrid", "explicit"] = "hybrid"
    width: Several = 64
    harmonics: Annotated[int, Ge(0), Le(HIGHEST_DEGREE)] = HIGHEST_DEGREE
    basis_width: Several = 128
    basis_depth: Count = 4
    sampling: Literal["occupancy", "proposals"] = "occupancy"
    steps: Samples = 256
    samples: Samples = 48
    proposal_samples: Annotated[Sequence[Samples], MinLen(1)] = (256, 128)
    proposal_resolutions: Sequence[Several] = (64, 128)
    proposal_channels: Count = 8
    annealing: Count = 1000
    teaching: Count = 5000

    def rehearsed(self, factor: float) -> Self:
        """Coarse proposals, which learn as often, too."""
        times = self.time_resolution
        return replace(
            super().rehearsed(factor),
            time_resolution=times and min(times, 16),
            proposal_samples=[min(count, 48) for count in self.proposal_samples],
            proposal_resolutions=[min(side, 32) for side in self.proposal_resolutions],
            annealing=max(1, round(self.annealing * factor)),
            teaching=max(1, round(self.teaching * factor)),
        )

    def __post_init__(self) -> None:
        fit = self.harmonics == HIGHEST_DEGREE or self.decoder == "hybrid"
        self.check("harmonics", fit, "3 with decoder=explicit, which has none")
        fit = len(self.proposal_samples) == len(self.proposal_resolutions)
        self.check("proposal_samples", fit, "as many numbers as proposal_resolutions has")

"""Sizes and sampling of K-Planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from devrf.methods.nerf.settings import OccupancySettings

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
        pairing: how features of the six planes meet: ``product``, or as in ``hexplane``.
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
    """

    hull: bool = False
    empty_from: float | None = 0.05
    resolution: int = 64
    scales: Sequence[int] = (1, 2, 4, 8)
    time_resolution: int | None = None
    channels: int = 32
    pairing: Pairing = "product"
    decoder: Literal["hybrid", "explicit"] = "hybrid"
    width: int = 64
    harmonics: int = HIGHEST_DEGREE
    basis_width: int = 128
    basis_depth: int = 4
    sampling: Literal["occupancy", "proposals"] = "occupancy"
    steps: int = 256
    samples: int = 48
    proposal_samples: Sequence[int] = (256, 128)
    proposal_resolutions: Sequence[int] = (64, 128)
    proposal_channels: int = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_least(2, "resolution", "width", "basis_width")
        self.check_least(1, "channels", "basis_depth", "proposal_channels")
        self.check_samples("steps", "samples")
        degree = self.harmonics
        fit = degree == HIGHEST_DEGREE or (
            0 <= degree < HIGHEST_DEGREE and self.decoder == "hybrid"
        )
        self.check("harmonics", fit, "0 to 3; 3 with decoder=explicit, which has none")
        fit = len(self.scales) > 0 and min(self.scales) >= 1
        self.check("scales", fit, "one or more numbers above 0")
        points = self.time_resolution
        self.check("time_resolution", points is None or points >= 2, "at least 2, or null")
        rounds = len(self.proposal_samples) == len(self.proposal_resolutions) > 0
        fit = rounds and min(*self.proposal_samples, *self.proposal_resolutions) >= 2
        self.check("proposal_samples", fit, "numbers from 2, as many as proposal_resolutions")

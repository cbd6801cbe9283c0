"""Sizes of Deformable 3D Gaussians, and how their cloud grows."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Le
from pydantic.dataclasses import dataclass

from devrf.methods.nerf.settings import Bands, MethodSettings
from devrf.system.options import Count, NotNegative, Positive, Share


@dataclass(frozen=True)
class GaussiansSettings(MethodSettings):
    """Sizes and growth; the defaults are the published ones (docs/methods/gaussians.md).

    Lengths are in units of the scene's extent, 1.1 times the distance of the farthest static camera
    from their middle, or the size of the near scene, if that is more; rates are factors of the
    network's learning rate.

    Attributes:
        start_points: Gaussians at first, at most.
        hull_side: the first lie on the surface of the visual hull on a grid of so many points a
            side, where there are alpha masks; 0: anywhere in the box.
        start_opacity: of the first.
        start_size: their sizes, in distances from their neighbours.
        max_points: Gaussians at most.
        harmonics: highest degree of the spherical harmonics of colours.
        harmonics_every: share of a stage after which their degree grows by 1.
        width: units of each layer of the deformation network.
        depth: its layers; the input enters the fifth once more, if there is one.
        embedding: numbers of each Gaussian that it reads beside its place, learned at its rate.
        bands: octaves of positions.
        time_bands: octaves of times.
        still: share of a stage in which nothing moves.
        means_rate, means_decay: rate of means, a length; the power that its decay has of the
            network's.
        scales_rate, quaternions_rate, opacity_rate, color_rate, harmonics_rate: other rates, which
            do not decay unless ``all_decay``.
        all_decay: whether all rates decay as the network's does.
        densify_from, densify_until, densify_every: shares of a stage: when Gaussians are added and
            pruned.
        densify_above: mean length of ∂L/∂centre, per half image, of those cloned or split.
        densify_share: the most of the Gaussians that are, at once: those of the longest.
        split_above: size from which one is split.
        split: into two at random places of it (``sampled``), or into two halves of its longest
            axis, of which the first keeps its moments (``halved``).
        prune_below: opacity below which one is pruned.
        prune_above: size above which one is pruned, after the first reset.
        reset_every: share of a stage after which opacities are at most ``RESET``; 0: never.
    """

    rehearsal: ClassVar = {"start_points": 1000, "max_points": 2000, "width": 64, "depth": 3}

    start_points: Count = 100_000
    hull_side: Annotated[int, Ge(0), Le(512)] = 0
    start_opacity: Annotated[float, Ge(0.01), Le(0.99)] = 0.1
    start_size: Positive = 1.0
    max_points: Count = 1_000_000
    harmonics: Annotated[int, Ge(0), Le(3)] = 3
    harmonics_every: Share = 0.025
    width: Count = 256
    depth: Count = 8
    embedding: Annotated[int, Ge(0), Le(64)] = 0
    bands: Bands = 10
    time_bands: Bands = 10
    still: Share = 0.075
    means_rate: Positive = 0.2
    means_decay: NotNegative = 0.741
    scales_rate: Positive = 1.25
    quaternions_rate: Positive = 1.25
    opacity_rate: Positive = 62.5
    color_rate: Positive = 3.125
    harmonics_rate: Positive = 0.15625
    all_decay: bool = False
    densify_from: Share = 0.0125
    densify_until: Share = 0.375
    densify_every: Annotated[float, Ge(0.001), Le(1)] = 0.0025
    densify_above: NotNegative = 2e-4
    densify_share: Share = 1.0
    split_above: NotNegative = 0.01
    split: Literal["sampled", "halved"] = "sampled"
    prune_below: Share = 0.005
    prune_above: Positive = 0.1
    reset_every: Share = 0.075

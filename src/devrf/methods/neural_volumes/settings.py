"""Sizes and sampling of Neural Volumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from devrf.methods.nerf.settings import CheckedSettings


@dataclass(frozen=True)
class NeuralVolumesSettings(CheckedSettings):
    """Sizes and sampling; the defaults are the published ones (docs/methods/neural_volumes.md).

    Attributes:
        code: numbers that describe a moment.
        encoder_views: training cameras whose images of a moment are encoded.
        encoder_size: height and width that these images are fitted into, in pixels.
        encoder_channels: of each convolution, which halves the image.
        encoder_width: units of the layer that joins the cameras.
        template_channels: of each level, from 1³ on; the volume has 2^levels voxels along an edge.
        warp: ``affinemix`` (a mixture of affine maps) or ``conv`` (a grid of displacements).
        warp_side: grid points of the warp along an edge (affinemix).
        maps: how many affine maps are mixed (affinemix).
        identity_start: whether the maps begin next to the identity; else, as published, with
            random scales around 0 (affinemix).
        warp_channels: of each level, from 1³ on; the grid has 2^levels points an edge (conv).
        warp_scale: displacement for an output of 1 (conv); the cube's edge is 2.
        density_scale: opacity per unit length of a softplus of 1, in the same unit.
        step: between samples, in the same unit.
        hull: whether what is outside the visual hull of each frame's masks is left out (not in the
            published method); else the whole cube is sampled.
        occupancy_side: the hulls have about side³ cells.
    """

    code: int = 256
    encoder_views: int = 3
    encoder_size: Sequence[int] = (512, 384)
    encoder_channels: Sequence[int] = (64, 64, 128, 128, 256, 256, 256)
    encoder_width: int = 512
    template_channels: Sequence[int] = (1024, 512, 512, 256, 256, 128, 128)
    warp: Literal["affinemix", "conv"] = "affinemix"
    warp_side: int = 32
    maps: int = 16
    identity_start: bool = False
    warp_channels: Sequence[int] = (1024, 512, 512, 256, 256)
    warp_scale: float = 2 / 1024
    density_scale: float = 1.0
    step: float = 4 / 256
    hull: bool = False
    occupancy_side: int = 128

    def __post_init__(self) -> None:
        self.check_least(1, "code", "encoder_views", "encoder_width", "maps")
        self.check_least(2, "occupancy_side", "warp_side")
        for name in ("density_scale", "warp_scale"):
            self.check(name, getattr(self, name) > 0, "more than 0")
        self.check("step", self.step >= 1 / 512, "at least 1/512")
        for name in ("encoder_channels", "template_channels", "warp_channels"):
            channels = getattr(self, name)
            self.check(name, len(channels) <= 8, "at most 8 levels")
            self.check(name, channels and min(channels) >= 1, "one or more numbers above 0")
        multiple = 2 ** len(self.encoder_channels)
        fits = [edge >= multiple and edge % multiple == 0 for edge in self.encoder_size]
        self.check("encoder_size", fits == [True, True], f"two multiples of {multiple}")

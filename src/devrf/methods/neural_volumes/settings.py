"""Sizes and sampling of Neural Volumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, ClassVar, Literal, Self

from annotated_types import Ge, Len
from pydantic.dataclasses import dataclass

from devrf.methods.nerf.settings import MethodSettings
from devrf.system.options import Count, Positive, Several

# Channels of layers, each of which halves or doubles.
Levels = Annotated[Sequence[Count], Len(1, 8)]


@dataclass(frozen=True)
class NeuralVolumesSettings(MethodSettings):
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
        maps: the number of affine maps that are mixed (affinemix).
        identity_start: whether the maps begin next to the identity; else, as published, with
            random scales around 0 (affinemix).
        warp_channels: of each level, from 1³ on; the grid has 2^levels points an edge (conv).
        warp_scale: displacement for an output of 1 (conv); the cube's edge is 2.
        density_scale: opacity per unit length of a softplus of 1, in the same unit.
        step: between samples, in the same unit.
        hull: whether space outside the visual hull of each frame's masks is left out (not in the
            published method); else the whole cube is sampled.
        occupancy_side: the hulls have about side³ cells.
    """

    rehearsal: ClassVar = {"code": 64, "encoder_width": 64, "warp_side": 16, "occupancy_side": 32}

    code: Count = 256
    encoder_views: Count = 3
    encoder_size: Sequence[int] = (512, 384)
    encoder_channels: Levels = (64, 64, 128, 128, 256, 256, 256)
    encoder_width: Count = 512
    template_channels: Levels = (1024, 512, 512, 256, 256, 128, 128)
    warp: Literal["affinemix", "conv"] = "affinemix"
    warp_side: Several = 32
    maps: Count = 16
    identity_start: bool = False
    warp_channels: Levels = (1024, 512, 512, 256, 256)
    warp_scale: Positive = 2 / 1024
    density_scale: Positive = 1.0
    step: Annotated[float, Ge(1 / 512)] = 4 / 256
    hull: bool = False
    occupancy_side: Several = 128

    def rehearsed(self, factor: float) -> Self:
        """Volumes of few voxels, too, by layers of few channels; small encoded images."""
        multiple = 2 ** len(self.encoder_channels)
        return replace(
            super().rehearsed(factor),
            encoder_size=[min(edge, multiple) for edge in self.encoder_size],
            encoder_channels=[min(channels, 32) for channels in self.encoder_channels],
            template_channels=[min(channels, 64) for channels in self.template_channels[:5]],
            warp_channels=[min(channels, 32) for channels in self.warp_channels[:4]],
            step=max(self.step, 1 / 16),
        )

    def __post_init__(self) -> None:
        multiple = 2 ** len(self.encoder_channels)
        fits = [edge >= multiple and edge % multiple == 0 for edge in self.encoder_size]
        self.check("encoder_size", fits == [True, True], f"two multiples of {multiple}")

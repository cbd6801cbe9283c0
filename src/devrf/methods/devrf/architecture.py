"""Sizes of the canonical field (docs/method.md#canonical-field)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.space import Space
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.color_decoder import ColorDecoder, SigmoidColor


@dataclass(frozen=True)
class Architecture:
    """Sizes of the canonical field; the defaults are the paper's, inward-facing.

    Attributes:
        channels: features per voxel.
        width: units of each of the colour decoder's two hidden layers.
        frequencies: octaves of the viewing direction that the decoder sees; 0 for the
            direction alone.
        alpha_init: opacity of a voxel of the radiance field before anything is learned.
        contracted_opacity: opacity of a line through the whole box, along an edge, before anything
            is learned; in contracted space it decides ``alpha_init``, whatever the resolution
            (docs/method.md#scene-contraction).
        search_alpha_init: the same in the coarse geometry search.
        planes: planes of an NDC grid, one behind another; None: in NDC as many as the scene's
            views tell apart (:mod:`devrf.methods.devrf.grid_resolution`), elsewhere cubic voxels.
        aspect: in NDC, grid points across a unit of x to those across a unit of y: the width of
            the images to their height makes voxels as square as pixels. The paper's is 1.
    """

    channels: int = 12
    width: int = 128
    frequencies: int = 4
    alpha_init: float = 1e-2
    contracted_opacity: float = 0.65
    search_alpha_init: float = 1e-6
    planes: int | None = None
    aspect: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.contracted_opacity < 1:
            raise DevrfError(
                f"field.contracted_opacity: expected between 0 and 1, not {self.contracted_opacity}"
            )

    def in_space(self, space: Space, side: float) -> Architecture:
        """The sizes that hold in ``space`` for a grid of ``side`` voxels along an edge."""
        if space.is_linear:
            return self
        return replace(self, alpha_init=1 - (1 - self.contracted_opacity) ** (1 / side))

    def search_field(self, box: Box, voxels: int) -> CanonicalField:
        """The field of the coarse geometry search: colours straight from three channels."""
        return CanonicalField(
            box, SigmoidColor(), channels=3, voxels=voxels, alpha_init=self.search_alpha_init
        )

    def radiance_field(self, box: Box, voxels: int, base_voxels: int) -> CanonicalField:
        """The radiance field: features and a shallow decoder."""
        return CanonicalField(
            box,
            ColorDecoder(self.channels, self.width, self.frequencies),
            channels=self.channels,
            voxels=voxels,
            base_voxels=base_voxels,
            alpha_init=self.alpha_init,
            planes=self.planes,
            aspect=self.aspect,
        )

"""The sampling of rays."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Gt, Le
from pydantic import BeforeValidator
from pydantic.dataclasses import dataclass

from devrf.system.options import Options

# A distance between samples, in voxels: shorter ones fill memory and show no more.
Step = Annotated[float, Ge(0.01)]
# Where they go through: devrf.geometry.cameras.pixel_positions.
# Pydantic would take true and 1.0 for 1.
RaysPerPixel = Annotated[
    Literal[1, 2, 4], BeforeValidator(lambda count: count if type(count) is int else str(count))
]


@dataclass(frozen=True)
class RenderSettings(Options):
    """The sampling of rays at the present resolution.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, are dropped before
            their colour is computed.
        near: the distance of the first sample, at least, in world units (or NDC).
        far: the distance of the last sample, at most, likewise.
        rays_per_pixel: of a batch, in learning.
        focal: the focal length of these images, in pixels.
    """

    key: ClassVar[str] = "sampling"

    step: Step
    alpha_threshold: float
    near: float
    far: float
    rays_per_pixel: RaysPerPixel = 1
    focal: Annotated[float, Gt(0), Le(1e9)] = 1.0

    def rays_at(self, focal: float) -> int:
        """Rays of a pixel of a picture of another ``focal`` length, in pixels: 4 or 1.

        1 where it was 1 in learning, and in pictures that are twice as large or larger, where rays
        through the centres are as close together as they were.
        """
        return 4 if self.rays_per_pixel > 1 and focal < 2 * self.focal else 1

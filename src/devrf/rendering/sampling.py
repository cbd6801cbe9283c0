"""How rays are sampled."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from devrf.errors import expect
from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.ops.march import steps_between

# The least distance between samples, in voxels: with less a ray fills memory and shows no more.
FINEST = 0.01


@dataclass(frozen=True)
class RenderSettings:
    """How rays are sampled at the present resolution.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, are dropped before
            their colour is computed.
        near: distance before which nothing is sampled, in world units (or NDC).
        far: distance behind which nothing is sampled, likewise.
    """

    step: float
    alpha_threshold: float
    near: float
    far: float

    def __post_init__(self) -> None:
        expect(self.step >= FINEST, "sampling.step", f"at least {FINEST}", self.step)


def steps_through(
    rays: Rays, box: Box, *, step: float, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Distance (R,) of each ray's first sample, and number (R,) int64 of samples up to its exit."""
    entry, leave = box.crossing(rays, near, far)
    return entry, steps_between(entry, leave, step)

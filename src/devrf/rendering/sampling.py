"""How rays are sampled."""

from __future__ import annotations

from dataclasses import dataclass

from devrf.errors import expect

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

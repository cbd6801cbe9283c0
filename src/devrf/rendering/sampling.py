"""How rays are sampled."""

from __future__ import annotations

from typing import Annotated, ClassVar

from annotated_types import Ge
from pydantic.dataclasses import dataclass

from devrf.system.options import Options

# A distance between samples, in voxels: with less a ray fills memory and shows no more.
Step = Annotated[float, Ge(0.01)]


@dataclass(frozen=True)
class RenderSettings(Options):
    """How rays are sampled at the present resolution.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, are dropped before
            their colour is computed.
        near: distance before which nothing is sampled, in world units (or NDC).
        far: distance behind which nothing is sampled, likewise.
    """

    key: ClassVar[str] = "sampling"

    step: Step
    alpha_threshold: float
    near: float
    far: float

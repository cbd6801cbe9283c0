"""The sampling of rays."""

from __future__ import annotations

from typing import Annotated, ClassVar

from annotated_types import Ge
from pydantic.dataclasses import dataclass

from devrf.system.options import Options

# A distance between samples, in voxels: shorter ones fill memory and show no more.
Step = Annotated[float, Ge(0.01)]


@dataclass(frozen=True)
class RenderSettings(Options):
    """The sampling of rays at the present resolution.

    Attributes:
        step: distance between samples in voxels of the present resolution.
        alpha_threshold: samples of a lower opacity, and then of a lower weight, are dropped before
            their colour is computed.
        near: the distance of the first sample, at least, in world units (or NDC).
        far: the distance of the last sample, at most, likewise.
    """

    key: ClassVar[str] = "sampling"

    step: Step
    alpha_threshold: float
    near: float
    far: float

"""The output of every method's renderer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class RenderOutput:
    """The rendering of R rays.

    Attributes:
        color: (R, 3) RGB, composited on the background: C = Σ w_i c_i + T_end · background.
        depth: (R,) mean distance of the samples, weighted by w_i; 0 where all weights are.
        transmittance: (R,) T_end, behind the last sample.
        extras: further tensors by name, for the losses of the method that rendered.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor
    extras: Mapping[str, Tensor] = field(default_factory=dict)

"""What rays see: the output of every method's renderer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class RenderOutput:
    """What R rays see.

    Attributes:
        color: (R, 3) RGB, composited on the background: C = Σ w_i c_i + T_end · background.
        depth: (R,) mean distance of what is seen along the ray; 0 where nothing is.
        transmittance: (R,) T_end, what is left of the ray behind the last sample.
        extras: further tensors by name, for the losses of the method that rendered.
    """

    color: Tensor
    depth: Tensor
    transmittance: Tensor
    extras: Mapping[str, Tensor] = field(default_factory=dict)

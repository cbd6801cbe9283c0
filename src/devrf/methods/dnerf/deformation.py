"""D-NeRF's deformation: positions and times → displacements to canonical space."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.methods.nerf.encoding import SinusoidalEncoding
from devrf.methods.nerf.mlp import Trunk

# The last layer's weights begin in ±SMALL, so that the first displacements are next to zero.
SMALL = 1e-4


class TranslationField(nn.Module):
    """Δ(x, t) = D(γ(x), γ(t)), and exactly 0 at t = 0 (docs/methods/dnerf.md#deformation)."""

    def __init__(
        self, width: int, depth: int, bands: int, time_bands: int, skip: int | None = None
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer.
            depth: layers.
            bands: octaves of the position.
            time_bands: octaves of the time.
            skip: the layer that γ(x) enters again; None: the middle one.
        """
        super().__init__()
        self.encode_position = SinusoidalEncoding(3, bands)
        self.encode_time = SinusoidalEncoding(1, time_bands)
        position, time = self.encode_position.size, self.encode_time.size
        self.trunk = Trunk(position + time, width, depth, skipped=position, skip=skip)
        self.output = nn.Linear(width, 3)
        nn.init.uniform_(self.output.weight, -SMALL, SMALL)
        nn.init.zeros_(self.output.bias)

    def forward(self, points: Tensor, time: Tensor) -> Tensor:
        """Displacements (S, 3) to canonical space.

        Args:
            points: (S, 3) in normalised space.
            time: (S,) in [0, 1]; where it is 0 nothing is displaced.
        """
        moving = (time > 0).nonzero()[:, 0]
        place, when = points.index_select(0, moving), time.index_select(0, moving)
        encoded = torch.cat([self.encode_position(place), self.encode_time(when[:, None])], dim=-1)
        found = self.output(self.trunk(encoded))
        return torch.zeros_like(points).index_copy(0, moving, found.to(points.dtype))

"""HyperNeRF's slicing surface: where in ambient space each point lies."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.methods.nerf.encoding import SinusoidalEncoding
from devrf.methods.nerf.mlp import Trunk, initialise

# Standard deviation of the last layer's first weights: all of space begins at w = 0, nearly.
SMALL = 1e-5


class SlicingSurface(nn.Module):
    """w = H(γ(x), ω): a deformable surface, as the ambient coordinate differs from point to point.

    See docs/methods/hypernerf.md#slicing.
    """

    def __init__(
        self, width: int, depth: int, bands: int, code: int, ambient: int, skip: int | None = None
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer.
            depth: layers.
            bands: octaves of the position, which does not enter by itself.
            code: length of a code ω.
            ambient: length of w.
            skip: the layer that the input enters again; None: the middle one.
        """
        super().__init__()
        self.encode = SinusoidalEncoding(3, bands, identity=False)
        self.trunk = Trunk(self.encode.size + code, width, depth, skip=skip)
        self.output = nn.Linear(width, ambient)
        initialise(self.trunk, "glorot")
        nn.init.normal_(self.output.weight, std=SMALL)
        nn.init.zeros_(self.output.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """w (S, ambient) at points (S, 3) in normalised space; their times' codes (S, code)."""
        w: Tensor = self.output(self.trunk(torch.cat([self.encode(points), code], dim=-1)))
        return w

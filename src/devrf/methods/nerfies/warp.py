"""Nerfies' warp: a rigid motion of its own for each point."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.geometry.poses import rigid_motion
from devrf.methods.nerf.encoding import SinusoidalEncoding, octave_window
from devrf.methods.nerf.mlp import Trunk, initialise

# The heads' weights begin in [0, SMALL), so that the first motions are next to none.
SMALL = 1e-4


class RigidWarp(nn.Module):
    """x′ = e^{[r]} x + G v with (r, v) = W(γ_α(x), ω) (docs/methods/nerfies.md#warp).

    Attributes:
        opened: () α, how many octaves of γ the window lets through; stored with the weights.
    """

    opened: Tensor

    def __init__(
        self, width: int, depth: int, bands: int, code: int, skip: int | None = None
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer.
            depth: layers.
            bands: octaves of the position.
            code: length of a code ω.
            skip: the layer that the input enters again; None: the middle one.
        """
        super().__init__()
        self.bands = bands
        self.encode = SinusoidalEncoding(3, bands)
        self.trunk = Trunk(self.encode.size + code, width, depth, skip=skip)
        self.rotation, self.velocity = nn.Linear(width, 3), nn.Linear(width, 3)
        self.register_buffer("opened", torch.zeros(()))
        initialise(self.trunk, "glorot")
        for head in (self.rotation, self.velocity):
            nn.init.uniform_(head.weight, 0, SMALL)
            nn.init.zeros_(head.bias)

    def forward(self, points: Tensor, code: Tensor) -> Tensor:
        """Where points lead.

        Args:
            points: (S, 3) in normalised space.
            code: (S, code) ω of each one's time.

        Returns:
            (S, 3) in normalised space.
        """
        window = octave_window(self.opened, self.bands)
        x = self.trunk(torch.cat([self.encode(points, window), code], dim=-1))
        rotation, velocity = self.rotation(x), self.velocity(x)
        return rigid_motion(points, rotation.to(points.dtype), velocity.to(points.dtype))

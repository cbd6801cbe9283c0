"""A neural radiance field: positions and directions → density and colour."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.methods.nerf.encoding import SinusoidalEncoding
from devrf.methods.nerf.mlp import Trunk


class RadianceField(nn.Module):
    """(x, d) → (σ, c): a trunk over γ(x), a density head, and a colour branch over γ(d).

    Attributes:
        density_scale: σ = scale · softplus(raw), per unit of normalised space.
    """

    def __init__(
        self, width: int, depth: int, bands: int, direction_bands: int, density_scale: float
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer of the trunk.
            depth: layers of the trunk.
            bands: octaves of the position.
            direction_bands: octaves of the viewing direction.
            density_scale: what a softplus of 1 means, per unit of normalised space.
        """
        super().__init__()
        self.density_scale = density_scale
        self.encode_position = SinusoidalEncoding(3, bands)
        self.encode_direction = SinusoidalEncoding(3, direction_bands)
        self.trunk = Trunk(self.encode_position.size, width, depth)
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.branch = nn.Linear(width + self.encode_direction.size, width // 2)
        self.color = nn.Linear(width // 2, 3)

    def forward(self, points: Tensor, viewdirs: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
        """Densities and colours of samples.

        Args:
            points: (S, 3) in normalised space, [−1, 1] inside the box.
            viewdirs: (R, 3) unit viewing directions of the rays.
            ray: (S,) int64, the ray of each sample.

        Returns:
            σ (S,) ≥ 0 per unit of normalised space, and RGB (S, 3) in [0, 1].
        """
        x = self.trunk(self.encode_position(points))
        density = self._density(x)
        direction = self.encode_direction(viewdirs).index_select(0, ray)
        x = torch.relu(self.branch(torch.cat([self.feature(x), direction], dim=-1)))
        return density, torch.sigmoid(self.color(x))

    def sigma(self, points: Tensor) -> Tensor:
        """σ (S,) alone, for samples whose colour does not count; ``points`` as above."""
        return self._density(self.trunk(self.encode_position(points)))

    def _density(self, features: Tensor) -> Tensor:
        raw: Tensor = self.density(features)[:, 0]
        return nn.functional.softplus(raw) * self.density_scale

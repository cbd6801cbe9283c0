"""A neural radiance field: positions and directions → density and colour."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from devrf.methods.nerf.encoding import SinusoidalEncoding
from devrf.methods.nerf.mlp import Initialisation, Trunk, initialise


class RadianceField(nn.Module):
    """(x, d) → (σ, c): a trunk over γ(x), a density head, and a colour branch over γ(d).

    Attributes:
        density_scale: σ = scale · softplus(raw), per unit of normalised space.
    """

    def __init__(
        self,
        width: int,
        depth: int,
        bands: int,
        direction_bands: int,
        density_scale: float,
        *,
        skip: int | None = None,
        ambient: int = 0,
        initialisation: Initialisation = "uniform",
    ) -> None:
        """Build the network.

        Args:
            width: units of each layer of the trunk.
            depth: layers of the trunk.
            bands: octaves of the position.
            direction_bands: octaves of the viewing direction.
            density_scale: what a softplus of 1 means, per unit of normalised space.
            skip: the layer of the trunk that γ(x) enters again; None: the middle one.
            ambient: length of what enters the trunk beside γ(x).
            initialisation: of all layers.
        """
        super().__init__()
        self.density_scale = density_scale
        self.encode_position = SinusoidalEncoding(3, bands)
        self.encode_direction = SinusoidalEncoding(3, direction_bands)
        self.trunk = Trunk(self.encode_position.size, width, depth, skip=skip, beside=ambient)
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.branch = nn.Linear(width + self.encode_direction.size, width // 2)
        self.color = nn.Linear(width // 2, 3)
        initialise(self, initialisation)

    def own_parameters(self) -> Iterator[nn.Parameter]:
        """All but :meth:`ambient_parameters`."""
        beside = {id(one) for one in self.ambient_parameters()}
        return (one for one in self.parameters() if id(one) not in beside)

    def ambient_parameters(self) -> Iterator[nn.Parameter]:
        """The weights of what enters beside γ(x)."""
        return self.trunk.beside_weights()

    def forward(
        self, points: Tensor, viewdirs: Tensor, ray: Tensor, ambient: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Densities and colours of samples.

        Args:
            points: (S, 3) in normalised space, [−1, 1] inside the box.
            viewdirs: (R, 3) unit viewing directions of the rays.
            ray: (S,) int64, the ray of each sample.
            ambient: (S, ambient) what enters beside γ(x), or None where nothing does.

        Returns:
            σ (S,) ≥ 0 per unit of normalised space, and RGB (S, 3) in [0, 1].
        """
        x = self.trunk(self.encode_position(points), ambient)
        density = self._density(x)
        direction = self.encode_direction(viewdirs).index_select(0, ray)
        x = torch.relu(self.branch(torch.cat([self.feature(x), direction], dim=-1)))
        return density, torch.sigmoid(self.color(x))

    def sigma(self, points: Tensor, ambient: Tensor | None = None) -> Tensor:
        """σ (S,) alone, for samples whose colour does not count; arguments as above."""
        return self._density(self.trunk(self.encode_position(points), ambient))

    def _density(self, features: Tensor) -> Tensor:
        raw: Tensor = self.density(features)[:, 0]
        return nn.functional.softplus(raw) * self.density_scale

"""Decoders of features into density and colour; no layer has a bias."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.geometry.box import constant
from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.nerf.networks import mlp

# Of spherical harmonics of degrees 0 to 3: √(1/4π), √(3/4π), √(15/4π), √(5/16π) and so on.
FACTORS = (
    0.2820948, -0.4886025, 0.4886025, -0.4886025, 1.0925484, -1.0925484, 0.3153916, -1.0925484,
    0.5462742, -0.5900436, 2.8906114, -0.4570458, 0.3731763, -0.4570458, 1.4453057, -0.5900436,
)  # fmt: skip
# Outputs of the first network beside the density.
FURTHER = 15
# The largest exponent of a density: more would be opaque likewise, and soon infinite.
STEEPEST = 15.0


def density_of(raw: Tensor) -> Tensor:
    """σ = e^(raw − 1) with an exponent within ±15, whose gradient does not end there."""
    exponent = raw - 1
    density = exponent.detach().clamp(-STEEPEST, STEEPEST).exp()
    return density * (1 + exponent - exponent.detach())


def spherical_harmonics(directions: Tensor) -> Tensor:
    """The real spherical harmonics of degrees 0 to 3, (R, 16), of unit vectors (R, 3)."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = directions.square().unbind(1)
    values = [
        torch.ones_like(x), y, z, x, x * y, y * z, 3 * zz - 1, x * z, xx - yy,
        y * (3 * xx - yy), x * y * z, y * (5 * zz - 1), z * (5 * zz - 3), x * (5 * zz - 1),
        z * (xx - yy), x * (xx - 3 * yy),
    ]  # fmt: skip
    return torch.stack(values, dim=1) * constant(FACTORS, x.dtype, x.device)


class HybridDecoder(nn.Module):
    """Features → density and 15 numbers; these and the direction → colour."""

    def __init__(self, size: int, settings: KPlanesSettings) -> None:
        super().__init__()
        self.geometry = mlp(size, settings.width, 1, FURTHER + 1, bias=False)
        self._directions = (settings.harmonics + 1) ** 2
        self.color = mlp(FURTHER + self._directions, settings.width, 2, 3, bias=False)

    def density(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """σ (S,) and the features for :meth:`rgb`, of features (S, size)."""
        values = self.geometry(features)
        return density_of(values[:, FURTHER]), values[:, :FURTHER]

    def rgb(self, further: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) in [0, 1] of samples of the rays ``ray`` (S,), whose directions are (R, 3)."""
        harmonics = spherical_harmonics(viewdirs)[:, : self._directions]
        direction = harmonics.index_select(0, ray)
        return torch.sigmoid(self.color(torch.cat([further, direction], dim=1)))


class ExplicitDecoder(nn.Module):
    """Density is linear in the features; so are colours, in a basis for each direction."""

    def __init__(self, size: int, settings: KPlanesSettings) -> None:
        super().__init__()
        self.geometry = nn.Linear(size, 1, bias=False)
        self.basis = mlp(3, settings.basis_width, settings.basis_depth, 3 * size, bias=False)

    def density(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """σ (S,), and the features (S, size) themselves, which :meth:`rgb` takes."""
        return density_of(self.geometry(features)[:, 0]), features

    def rgb(self, features: Tensor, viewdirs: Tensor, ray: Tensor) -> Tensor:
        """RGB (S, 3) in [0, 1]; arguments as of the hybrid decoder."""
        basis = self.basis(viewdirs).view(len(viewdirs), 3, -1).index_select(0, ray)
        return torch.sigmoid(torch.einsum("sf,scf->sc", features, basis))

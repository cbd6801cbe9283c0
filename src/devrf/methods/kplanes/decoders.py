"""Decoders of features into density and colour; no layer has a bias."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.nerf.networks import mlp
from devrf.ops.spherical_harmonics import spherical_harmonics

# Outputs of the first network beside the density.
FURTHER = 15
# The largest exponent of a density: more would be opaque likewise, and soon infinite.
STEEPEST = 15.0


def density_of(raw: Tensor) -> Tensor:
    """σ = e^(raw − 1) with an exponent within ±15, whose gradient does not end there."""
    exponent = raw - 1
    density = exponent.detach().clamp(-STEEPEST, STEEPEST).exp()
    return density * (1 + exponent - exponent.detach())


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

"""Samples by rounds of proposals: small fields that learn where a ray has weight."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from devrf.geometry.rays import Rays
from devrf.methods.kplanes.decoders import density_of
from devrf.methods.kplanes.planes import SixPlanes
from devrf.methods.kplanes.settings import KPlanesSettings
from devrf.methods.nerf.networks import mlp
from devrf.methods.nerf.samples import RaySamples, drawn

# Added to each weight before samples are drawn by it.
PADDING = 0.01
# Against division by zero weights.
LEAST = 1e-7
WIDTH = 64


class Proposal(nn.Module):
    """σ alone, from six planes of one scale."""

    def __init__(self, resolution: int, time_resolution: int, settings: KPlanesSettings) -> None:
        """Planes of these resolutions; the network is linear where colours are explicit."""
        super().__init__()
        channels = settings.proposal_channels
        self.planes = SixPlanes(channels, [resolution], time_resolution, highest=0.15)
        layers = mlp(channels, WIDTH, 1, 1, bias=False)
        self.decoder = (
            layers if settings.decoder == "hybrid" else nn.Sequential(layers[0], layers[2])
        )

    def forward(self, points: Tensor) -> Tensor:
        """σ (S,) at points (S, 4) of space and time in [0, 1]."""
        return density_of(self.decoder(self.planes(points))[:, 0])


def intervals(rays: Rays, edges: Tensor) -> RaySamples:
    """A sample in the middle of each interval between ``edges`` (R, N + 1), ascending distances."""
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    ray = torch.arange(len(rays), device=edges.device).repeat_interleave(middle.shape[1])
    return RaySamples.at(rays, ray, middle.reshape(-1), edges.diff(dim=1).reshape(-1))


def drawn_edges(edges: Tensor, weight: Tensor, count: int, *, jitter: bool) -> Tensor:
    """Edges (R, count + 1) of intervals that are equally likely, inner ones jittered if asked.

    ``weight`` (R, N) is that of the intervals between ``edges`` (R, N + 1), without gradient.
    """
    position = torch.arange(count + 1, device=edges.device).repeat(len(edges), 1).to(edges.dtype)
    if jitter:
        position[:, 1:-1] += torch.rand_like(position[:, 1:-1]) - 0.5
    return drawn(edges, weight + PADDING, position / count)


def histogram_error(
    edges: Tensor, weight: Tensor, proposed_edges: Tensor, proposed: Tensor
) -> Tensor:
    """Mean over rays and intervals of max(0, w_i − b_i)² / w_i (mip-NeRF 360, equation 13).

    The equation is a sum over a ray's intervals; the mean is the release's.

    w_i is the ``weight`` (R, N) between ``edges`` (R, N + 1) i and i + 1, and has no gradient; b_i
    the sum of the ``proposed`` (R, M) over those between ``proposed_edges`` that overlap with it.
    """
    reached = torch.cat([torch.zeros_like(proposed[:, :1]), proposed.cumsum(dim=1)], dim=1)
    last = proposed_edges.shape[1] - 1
    first = torch.searchsorted(proposed_edges, edges[:, :-1].contiguous(), right=True) - 1
    after = torch.searchsorted(proposed_edges, edges[:, 1:].contiguous())
    bound = reached.gather(1, after.clamp(0, last)) - reached.gather(1, first.clamp(0, last))
    weight = weight.detach()
    return ((weight - bound).clamp(min=0).square() / (weight + LEAST)).mean()

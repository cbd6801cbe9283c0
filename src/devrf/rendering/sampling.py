"""From rays to the sample points worth looking at."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.rendering.occupancy import Occupancy


@dataclass(frozen=True)
class Samples:
    """S samples of R rays, one after another: ascending by ray, then front to back.

    Attributes:
        ray: (S,) int64, the ray of each sample.
        distance: (S,) along the ray, in units of its direction.
        points: (S, 3) positions in the fields' space.
        rays: R, how many rays there are.
        present: None, or (S,) bool where the list is longer than need be: which places are
            samples. The others have no weight; what else stands there is finite, but means
            nothing.
    """

    ray: Tensor
    distance: Tensor
    points: Tensor
    rays: int
    present: Tensor | None = None

    def __len__(self) -> int:
        return self.ray.shape[0]

    def __getitem__(self, index: Tensor) -> Samples:
        """The samples at ascending positions ``index`` (K,)."""
        return Samples(
            self.ray.index_select(0, index),
            self.distance.index_select(0, index),
            self.points.t().index_select(1, index).t(),
            self.rays,
            None if self.present is None else self.present.index_select(0, index),
        )


def steps_through(
    rays: Rays, box: Box, *, step: float, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Where the samples of R rays begin, and how many fit: arguments as :func:`march`.

    Returns:
        distance (R,) of each ray's first sample, and how many (R,) int64 there are up to its exit.
    """
    entry, leave = box.crossing(rays)
    entry, leave = entry.clamp(min=near), leave.clamp(max=far)
    # The sample on the way out counts: in NDC it is the last plane, which closes the scene.
    count = torch.where(leave >= entry, ((leave - entry) / step + 1e-3).floor() + 1, 0.0)
    return entry, count.long()


def most_steps(box: Box, *, step: float, near: float, far: float) -> int:
    """No ray has more samples, whose direction is at least of length 1: arguments as above."""
    diagonal = sum(edge**2 for edge in box.size) ** 0.5
    return int(min(far - near, diagonal) / step) + 2


@torch.no_grad()
def march(
    rays: Rays,
    box: Box,
    occupancy: Occupancy,
    *,
    step: float,
    near: float,
    far: float,
) -> Samples:
    """Samples every ``step`` along rays between their entry into the box and their exit.

    Empty space is skipped in two strides: whole stretches of a ray with nothing near them,
    then single samples.

    Args:
        rays: R rays.
        box: where samples may be.
        occupancy: where something may be.
        step: distance between samples, in units of the rays' directions.
        near: distance before which nothing is sampled.
        far: distance behind which nothing is sampled.

    Returns:
        The samples in occupied cells; the k-th of a ray is at entry + k·step.
    """
    entry, count = steps_through(rays, box, step=step, near=near, far=far)
    per_stretch = max(1, int(2 * _reach(rays, occupancy) / step))
    stretches = (count + per_stretch - 1) // per_stretch
    ray = torch.repeat_interleave(stretches)
    first = stretches.cumsum(0) - stretches
    start = torch.arange(len(ray), device=ray.device).sub_(first.index_select(0, ray))
    start *= per_stretch
    middle = entry.index_select(0, ray) + step * (start + (per_stretch - 1) / 2)
    kept = occupancy.near(rays.at(ray, middle)).nonzero()[:, 0]
    ray, start = ray.index_select(0, kept), start.index_select(0, kept)
    number = (start[:, None] + torch.arange(per_stretch, device=ray.device)).reshape(-1)
    ray = ray.repeat_interleave(per_stretch)
    distance = entry.index_select(0, ray).add_(number, alpha=step)
    points = rays.at(ray, distance)
    met = occupancy.at(points) & (number < count.index_select(0, ray))
    kept = met.nonzero()[:, 0]
    return Samples(
        ray.index_select(0, kept),
        distance.index_select(0, kept),
        points.t().index_select(1, kept).t(),
        len(rays),
    )


def _reach(rays: Rays, occupancy: Occupancy) -> float:
    """The vicinity's reach in units of the rays' directions, which in NDC are no unit vectors."""
    lengths = rays.directions.norm(dim=1)
    return occupancy.reach / max(float(lengths.amax()), 1e-9) if len(rays) else occupancy.reach


@torch.no_grad()
def hits(
    rays: Rays, box: Box, occupancy: Occupancy, *, near: float, far: float, chunk: int = 65536
) -> Tensor:
    """Mask (R,): which rays pass within reach of anything occupied."""
    return torch.cat(
        [
            _hits(rays[k : k + chunk], box, occupancy, near, far)
            for k in range(0, max(len(rays), 1), chunk)
        ]
    )


def _hits(rays: Rays, box: Box, occupancy: Occupancy, near: float, far: float) -> Tensor:
    entry, leave = box.crossing(rays)
    entry, leave = entry.clamp(min=near), leave.clamp(max=far)
    stride = _reach(rays, occupancy)
    strides = ((leave - entry) / stride).clamp(min=0).ceil().long()
    ray = torch.repeat_interleave(strides)
    first = strides.cumsum(0) - strides
    number = torch.arange(len(ray), device=ray.device) - first[ray]
    touched = occupancy.near(rays.at(ray, entry[ray] + (number + 0.5) * stride))
    hit = torch.zeros(len(rays), dtype=torch.bool, device=ray.device)
    hit[ray[touched]] = True
    return hit

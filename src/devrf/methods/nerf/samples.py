"""Samples along rays: their drawing, and their compositing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.nerf.placement import Placement
from devrf.ops.compositing import mean_distance, sum_by_ray
from devrf.rendering.output import RenderOutput

# A length that is opaque at any density that a softplus gives.
UNBOUNDED = 1e10


@dataclass(frozen=True)
class RaySamples:
    """S samples of R rays: ascending by ray, then front to back.

    Attributes:
        ray: (S,) int64, the ray of each sample.
        distance: (S,) along the ray, in units of its direction.
        length: (S,) of the stretch that each sample stands for, in units of the points' space.
        points: (S, 3) positions in the fields' space, or in normalised space.
        rays: R.
    """

    ray: Tensor
    distance: Tensor
    length: Tensor
    points: Tensor
    rays: int

    @staticmethod
    def at(rays: Rays, ray: Tensor, distance: Tensor, stretch: Tensor | float) -> RaySamples:
        """Samples at ``distance`` (S,) along the rays ``ray`` (S,) int64.

        Each stands for a ``stretch`` (S,) or a number; both are in units of the rays' directions.
        """
        unit = rays.directions.norm(dim=1).index_select(0, ray)
        return RaySamples(ray, distance, unit * stretch, rays.at(ray, distance), len(rays))

    def __getitem__(self, index: Tensor) -> RaySamples:
        """Some of the samples, by their numbers (K,), ascending."""
        return RaySamples(
            ray=self.ray.index_select(0, index),
            distance=self.distance.index_select(0, index),
            length=self.length.index_select(0, index),
            points=self.points.index_select(0, index),
            rays=self.rays,
        )

    def normalised(self, placement: Placement) -> RaySamples:
        """The same samples, points and lengths in normalised space; distances stay as they are."""
        points = placement.normalised(self.points)
        return replace(self, points=points, length=self.length / placement.half_edge)

    def unbounded(self) -> RaySamples:
        """The same samples, the last of each ray standing for all that is behind it."""
        return replace(self, length=torch.where(last_of_ray(self.ray), UNBOUNDED, self.length))


def last_of_ray(ray: Tensor) -> Tensor:
    """(S,) bool, which samples are the last of their rays ``ray`` (S,) int64, ascending."""
    following = torch.cat([ray[1:], ray.new_full((1,), -1)])[: len(ray)]
    return ray != following


def accumulated(
    samples: RaySamples, weight: Tensor, color: Tensor, transmittance: Tensor, background: Tensor
) -> RenderOutput:
    """C = Σ w_i c_i + T_end · background, and the samples' mean distance.

    Weights and transmittance are those of :func:`~devrf.ops.compositing.composite`.

    Args:
        samples: S samples of R rays.
        weight: (S,) w_i.
        color: (S, 3) w_i c_i.
        transmittance: (R,) T_end.
        background: (3,) or (R, 3) RGB.
    """
    ray = samples.ray
    rays = samples.rays
    return RenderOutput(
        color=sum_by_ray(color, ray, rays) + transmittance[:, None] * background,
        depth=mean_distance(weight, samples.distance, ray, rays),
        transmittance=transmittance,
    )


def limits(rays: Rays, box: Box, depths: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Distances (R,) between which R rays are sampled: inside the box, from near to far.

    A ray that misses the box is sampled in a stretch of no length.
    """
    nearest, farthest = depths
    entry, leave = box.crossing(rays, nearest, farthest)
    near = entry.clamp(max=farthest)
    return near, torch.maximum(leave, near)


def stratified(near: Tensor, far: Tensor, count: int, *, jitter: bool) -> Tensor:
    """Distances (R, count), one in each of as many equal stretches.

    Args:
        near: (R,) the start of the first stretch.
        far: (R,) the end of the last one.
        count: the number of stretches.
        jitter: a random position in each stretch; else its middle.
    """
    index = torch.arange(count, device=near.device).expand(len(near), count)
    offset = torch.rand_like(near[:, None].expand(-1, count)) if jitter else 0.5
    return near[:, None] + (far - near)[:, None] * (index + offset) / count


def importance(
    distance: Tensor, weight: Tensor, near: Tensor, far: Tensor, count: int, *, jitter: bool
) -> Tensor:
    """Distances (R, count) drawn in proportion to the weights of coarse samples.

    The stretches end half-way between the coarse samples; each is as likely as its weight says,
    and a position within it is drawn evenly (inverse transform sampling).

    Args:
        distance: (R, N) of the coarse samples, ascending.
        weight: (R, N) theirs.
        near: (R,) the start of the first stretch.
        far: (R,) the end of the last one.
        count: the number to draw.
        jitter: random numbers; else evenly spread ones.
    """
    middle = (distance[:, 1:] + distance[:, :-1]) / 2
    edge = torch.cat([near[:, None], middle, far[:, None]], dim=1)
    wanted = stratified(torch.zeros_like(near), torch.ones_like(far), count, jitter=jitter)
    return drawn(edge, weight + 1e-5, wanted)


def drawn(edges: Tensor, weight: Tensor, wanted: Tensor) -> Tensor:
    """Distances (R, M) at which shares ``wanted`` (R, M) of a ray's weight are reached.

    ``weight`` (R, N) > 0 is that of the intervals between ``edges`` (R, N + 1), even within each.
    """
    reached = torch.cumsum(weight / weight.sum(dim=1, keepdim=True), dim=1)
    reached = torch.cat([torch.zeros_like(reached[:, :1]), reached], dim=1)
    above = torch.searchsorted(reached, wanted.contiguous(), right=True)
    above = above.clamp(min=1, max=edges.shape[1] - 1)
    low = reached.gather(1, above - 1)
    high = reached.gather(1, above)
    within = ((wanted - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)
    return torch.lerp(edges.gather(1, above - 1), edges.gather(1, above), within)


def flattened(rays: Rays, distance: Tensor, far: Tensor) -> RaySamples:
    """Samples at distances (R, N), ascending: each stands for the stretch up to the next."""
    stretch = torch.cat([distance[:, 1:], far[:, None]], dim=1) - distance
    ray = torch.arange(len(rays), device=distance.device).repeat_interleave(distance.shape[1])
    return RaySamples.at(rays, ray, distance.reshape(-1), stretch.reshape(-1).clamp(min=0))

"""The march along rays: samples in occupied space, warped and composited.

See docs/method.md#rays, #warp, #density and #compositing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.ops.compositing import composite, mean_distance, transmittances
from devrf.ops.trilinear import interpolate

# A ray ends where its transmittance is less: what is behind cannot be seen.
STOP = 1e-4
# A sample so little behind a ray's exit still counts, in steps: rounding does not decide on it.
EXIT = 1e-3


@dataclass(frozen=True)
class Surroundings:
    """How far it is to what is occupied, so that empty space is not sampled.

    Attributes:
        distances: (X, Y, Z) uint8, from each grid point the cells to the nearest occupied one along
            the axis along which it is farthest, at least; 0 in occupied cells.
        box: the box of the grid; a point is looked up at its nearest grid point, and outside the
            box everything is empty.
    """

    distances: Tensor
    box: Box

    def at(self, points: Tensor) -> Tensor:
        """Distances (M,) uint8 at ``points`` (M, 3); outside the box 1."""
        shape = self.distances.shape
        place = self.box.to_grid(points, (shape[0], shape[1], shape[2])).round().long()
        size = torch.tensor(shape, device=points.device)
        inside = ((place >= 0) & (place < size)).all(dim=1)
        x, y, z = place.clamp(min=0).minimum(size - 1).unbind(1)
        return torch.where(inside, self.distances[x, y, z], 1)


@dataclass(frozen=True)
class Path:
    """Where rays are sampled.

    Attributes:
        box: nothing is outside.
        surroundings: where something may be.
        step: the distance between samples, in units of the rays' directions.
        near: the distance before which nothing is sampled.
        far: the distance behind which nothing is sampled.
    """

    box: Box
    surroundings: Surroundings
    step: float
    near: float
    far: float


@dataclass(frozen=True)
class Medium:
    """What rays are followed through.

    Attributes:
        path: where rays are sampled, within the box of the densities.
        density: (X, Y, Z, 1) raw densities v.
        shift: b, added to raw densities.
        delta: δ, the length of a step in base voxels.
        threshold: the opacity, and then the weight, from which on a sample is worth a colour.
        displacement: (X, Y, Z, 3) Δ of x → q = x + Δ(x); None is the identity.
        motion_box: where the displacements lie; None without.
        still_outside: whether Δ is 0 outside that box; else it is as on its border.
    """

    path: Path
    density: Tensor
    shift: float
    delta: float
    threshold: float
    displacement: Tensor | None = None
    motion_box: Box | None = None
    still_outside: bool = False


@dataclass(frozen=True)
class Samples:
    """What R rays meet: K samples that are worth a colour, by ray, then front to back.

    Attributes:
        ray: (K,) int64, ascending, the ray of each.
        distance: (K,) along the ray, in units of its direction.
        points: (K, 3) positions x in the fields' space.
        canonical: (K, 3) positions q in canonical space.
        weight: (K,) w = T α.
        transmittance: (R,) T_end, behind the last sample of each ray.
        depth: (R,) Σ w_i z_i / Σ w_i over a ray's samples at distances z, 0 without any; it has no
            gradient.
    """

    ray: Tensor
    distance: Tensor
    points: Tensor
    canonical: Tensor
    weight: Tensor
    transmittance: Tensor
    depth: Tensor


def march(rays: Rays, medium: Medium) -> Samples:
    """Samples every step from a ray's entry into the box to its exit, in occupied cells.

    The k-th of a ray is at entry + k·step. Those of too low an opacity count as empty, and what is
    behind a transmittance of ``STOP`` is left out. Differentiable in the densities and the
    displacements, through ``canonical``, ``weight`` and ``transmittance``.

    Args:
        rays: R rays.
        medium: what they are followed through.
    """
    ray, distance, points = samples_in_box(rays, medium.path)
    occupied = (medium.path.surroundings.at(points) == 0).nonzero()[:, 0]
    ray, distance, points = ray[occupied], distance[occupied], points[occupied]
    canonical = warped(points, medium)
    raw = interpolate(medium.density, canonical, medium.path.box)[:, 0]
    tau = softplus(raw + medium.shift) * medium.delta

    with torch.no_grad():
        visible = (-torch.expm1(-tau) >= medium.threshold).nonzero()[:, 0]
        left = transmittances(tau[visible], ray[visible], len(rays))
        visible = visible[left >= STOP]
    weight, transmittance = composite(tau[visible], ray[visible], len(rays))
    significant = (weight >= medium.threshold).nonzero()[:, 0]
    kept = visible[significant]
    depth = mean_distance(weight[significant], distance[kept], ray[kept], len(rays))
    return Samples(
        ray=ray[kept],
        distance=distance[kept],
        points=points[kept],
        canonical=canonical[kept],
        weight=weight[significant],
        transmittance=transmittance,
        depth=depth,
    )


def samples_in_box(rays: Rays, path: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Ray (S,), distance (S,) and position (S, 3) of all samples, in empty space, too."""
    entry, count = steps_through(rays, path.box, step=path.step, near=path.near, far=path.far)
    ray, number = numbered(count)
    distance = entry[ray] + path.step * number
    return ray, distance, rays.at(ray, distance)


def warped(points: Tensor, medium: Medium) -> Tensor:
    """q = x + Δ(x) (M, 3) of ``points`` x (M, 3)."""
    if medium.displacement is None or medium.motion_box is None:
        return points
    move = interpolate(medium.displacement, points, medium.motion_box)
    if medium.still_outside:
        move = torch.where(medium.motion_box.contains(points)[:, None], move, 0.0)
    return points + move


def steps_through(
    rays: Rays, box: Box, *, step: float, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Distance (R,) of each ray's first sample, and number (R,) int64 of samples up to its exit.

    A sample exactly at the exit counts: in NDC it is the last plane, behind the whole scene.
    """
    entry, leave = box.crossing(rays, near, far)
    count = torch.where(leave >= entry, ((leave - entry) / step + EXIT).floor() + 1, 0.0)
    return entry, count.long()


def numbered(count: Tensor) -> tuple[Tensor, Tensor]:
    """The ray (S,) int64 of each sample of rays that have so many (R,), and its number on it."""
    ray = torch.repeat_interleave(count)
    first = (count.cumsum(0) - count).index_select(0, ray)
    return ray, torch.arange(len(ray), device=ray.device) - first

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
from devrf.ops.compositing import composite, firsts, mean_distance, transmittances
from devrf.ops.trilinear import interpolate, shape_of

# A ray ends where its transmittance is less: samples behind are invisible.
STOP = 1e-4
# A sample so little behind a ray's exit still counts, in steps: rounding does not decide on it.
EXIT = 1e-3


@dataclass(frozen=True)
class OccupancyDistances:
    """Distances to the nearest occupied cell, so that empty space is not sampled.

    Attributes:
        cells: (X, Y, Z) uint8, from each grid point at least so many cells to the nearest occupied
            one, along the axis along which it is farthest; 0 in occupied cells.
        box: the box of the grid; a point reads its nearest grid point, and outside the box
            everything is empty.
    """

    cells: Tensor
    box: Box

    def at(self, points: Tensor) -> Tensor:
        """Distances (M,) uint8 at ``points`` (M, 3); outside the box 1."""
        shape = shape_of(self.cells)
        index = self.box.to_grid(points, shape).round().long()
        size = torch.tensor(shape, device=points.device)
        inside = ((index >= 0) & (index < size)).all(dim=1)
        x, y, z = index.clamp(min=0).minimum(size - 1).unbind(1)
        return torch.where(inside, self.cells[x, y, z], 1)


@dataclass(frozen=True)
class MarchRange:
    """The part of rays that is sampled.

    Attributes:
        box: rays are sampled inside it.
        distances: occupied cells are sampled.
        step: the distance between samples, in units of the rays' directions.
        near: the distance of the first sample, at least.
        far: the distance of the last sample, at most.
    """

    box: Box
    distances: OccupancyDistances
    step: float
    near: float
    far: float


@dataclass(frozen=True)
class MarchInputs:
    """A scene at one time, as the march reads it.

    Attributes:
        range: the part of rays that is sampled, within the box of the densities.
        density: (X, Y, Z, 1) raw densities v.
        shift: b, added to raw densities.
        delta: δ, the length of a step in base voxels.
        threshold: the opacity, and then the weight, from which on a sample is worth a colour.
        displacement: (X, Y, Z, 3) Δ of x → q = x + Δ(x); None is the identity.
        displacement_box: the box of the displacements; None without.
        zero_outside_box: whether Δ is 0 outside that box; else it is as on its border.
    """

    range: MarchRange
    density: Tensor
    shift: float
    delta: float
    threshold: float
    displacement: Tensor | None = None
    displacement_box: Box | None = None
    zero_outside_box: bool = False


@dataclass(frozen=True)
class Samples:
    """K samples of R rays that are worth a colour, by ray, then front to back.

    Attributes:
        ray: (K,) int64, ascending, the ray of each.
        distance: (K,) along the ray, in units of its direction.
        points: (K, 3) positions x in the fields' space.
        canonical: (K, 3) positions q in canonical space.
        weight: (K,) w = T α.
        transmittance: (R,) T_end, behind the last sample of each ray.
        depth: (R,) Σ w_i z_i / Σ w_i over a ray's samples at distances z, 0 without any; it has no
            gradient.
        stop: (R,) int64, the number of samples of each ray and of those before it.
    """

    ray: Tensor
    distance: Tensor
    points: Tensor
    canonical: Tensor
    weight: Tensor
    transmittance: Tensor
    depth: Tensor
    stop: Tensor


def march(rays: Rays, inputs: MarchInputs) -> Samples:
    """Samples every step from a ray's entry into the box to its exit, in occupied cells.

    The k-th of a ray is at entry + k·step. Samples of too low an opacity count as empty, and
    those behind a transmittance of ``STOP`` are left out. Differentiable in the densities and the
    displacements, through ``canonical``, ``weight`` and ``transmittance``.

    Args:
        rays: R rays.
        inputs: the scene at the rays' time.
    """
    ray, distance, points = samples_in_box(rays, inputs.range)
    occupied = (inputs.range.distances.at(points) == 0).nonzero()[:, 0]
    ray, distance, points = ray[occupied], distance[occupied], points[occupied]
    canonical = warped(points, inputs)
    raw = interpolate(inputs.density, canonical, inputs.range.box)[:, 0]
    tau = softplus(raw + inputs.shift) * inputs.delta

    with torch.no_grad():
        visible = (-torch.expm1(-tau) >= inputs.threshold).nonzero()[:, 0]
        before = transmittances(tau[visible], ray[visible], len(rays))
        visible = visible[before >= STOP]
    weight, transmittance = composite(tau[visible], ray[visible], len(rays))
    significant = (weight >= inputs.threshold).nonzero()[:, 0]
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
        stop=firsts(ray[kept], len(rays))[1:],
    )


def samples_in_box(rays: Rays, limits: MarchRange) -> tuple[Tensor, Tensor, Tensor]:
    """Ray (S,), distance (S,) and position (S, 3) of all samples, in empty space, too."""
    entry, count = steps_through(
        rays, limits.box, step=limits.step, near=limits.near, far=limits.far
    )
    ray, number = numbered(count)
    distance = entry[ray] + limits.step * number
    return ray, distance, rays.at(ray, distance)


def warped(points: Tensor, inputs: MarchInputs) -> Tensor:
    """q = x + Δ(x) (M, 3) of ``points`` x (M, 3)."""
    if inputs.displacement is None or inputs.displacement_box is None:
        return points
    move = interpolate(inputs.displacement, points, inputs.displacement_box)
    if inputs.zero_outside_box:
        move = torch.where(inputs.displacement_box.contains(points)[:, None], move, 0.0)
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

"""The cycle and the flow term of listed samples and their weighted sum, in one pass over them.

See docs/method.md#motion-losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.ops.corners import Corners, Triple, axes_of, shape_of, to_grid
from devrf.ops.dispatch import accelerated
from devrf.ops.trilinear import interpolate, kept_gradient

# A depth nearer to 0 counts as so much; what is exactly at infinity in NDC, as so much before it.
# As in devrf.geometry.
NEAREST, BEFORE_INFINITY = 1e-8, 1e-6


class ListedSamples(NamedTuple):
    """K samples of rays at a frame's time, in a list of fixed length.

    Attributes:
        points: (K, 3) x, where they are; they get no gradient.
        canonical: (K, 3) q, where they were at rest.
        weight: (K,) w.
        ray: (K,) int64, the ray of each; any ray in the padding.
        present: (K,) bool, which places hold a sample.
    """

    points: Tensor
    canonical: Tensor
    weight: Tensor
    ray: Tensor
    present: Tensor


class SeenEarlier(NamedTuple):
    """Where the pixels of R rays were one frame earlier, as observed, and the cameras.

    Attributes:
        vectors: (R, 2) observed backward flow in pixels, finite where it is not valid, too.
        valid: (R,) bool.
        pixel: (R, 2) x, y of the pixels.
        image: (R,) int64, the image of each ray.
        previous: (N,) int64, for each image the one that its flow leads to.
        poses: (N, 3, 4) camera to world, OpenGL axes.
        focal: (N, 2) in pixels.
        center: (N, 2) principal points in pixels.
    """

    vectors: Tensor
    valid: Tensor
    pixel: Tensor
    image: Tensor
    previous: Tensor
    poses: Tensor
    focal: Tensor
    center: Tensor


def cycle_error(points: Tensor, returned: Tensor) -> Tensor:
    """½ |x − (q + Δ_f(q))|² (K,) of samples x (K, 3) and of where they return to (K, 3)."""
    return 0.5 * (points - returned).square().sum(dim=1)


def flow_error(weight: Tensor, induced: Tensor, observed: Tensor, count: Tensor) -> Tensor:
    """(1/M) Σ_i w_i |φ_i − φ|₁ ().

    Args:
        weight: (K,) w of the samples on rays with flow, 0 in padding.
        induced: (K, 2) φ_i in pixels.
        observed: (K, 2) φ of their rays.
        count: () M.
    """
    return (weight * (induced - observed).abs().sum(dim=1)).sum() / count.clamp(min=1)


class MotionSum(NamedTuple):
    """What the motion of listed samples lacks.

    Attributes:
        total: () Σ weight · term; differentiable once in ``canonical``, ``weight``, ``forward``.
        terms: (2,) cycle and flow; not differentiable.
    """

    total: Tensor
    terms: Tensor


def motion_sum(
    samples: ListedSamples,
    forward: Tensor,
    before: Tensor,
    earlier: SeenEarlier | None,
    weights: Sequence[float],
    *,
    box: Corners,
    over_samples: bool,
    ndc: Triple | None = None,
) -> MotionSum:
    """Both terms, and Σ weight · term; the gradient of ``forward`` is added to what it has.

    Cycle is the mean over samples of ``½ |x − (q + Δ_f(q))|²``. Flow is
    ``(1/M) Σ_i w_i |φ_i − φ|₁`` over the samples on valid rays, with
    ``φ_i = π(q_i + Δ_before(q_i)) − u`` in pixels; M is the number of valid rays, or twice the
    number of those samples.

    Args:
        samples: K samples.
        forward: (X, Y, Z, 3) Δ_f of the frame, in the box's units.
        before: (X, Y, Z, 3) Δ_f of the frame before; it gets no gradient.
        earlier: the flow at the rays' pixels; None: there is none, and the term is 0.
        weights: of cycle and flow.
        box: the box of both grids.
        over_samples: whether flow is a mean over samples, else over rays.
        ndc: slopes 2f/W, 2f/H and near plane of the normalised device coordinates that points are
            in; None: they are in world units.
    """
    floats = *samples[:3], forward, before, *((earlier.vectors, earlier.poses) if earlier else ())
    if kernels := accelerated("motion", *floats):
        total, terms = kernels.motion_sum(
            *(samples.canonical, samples.weight, forward),
            (samples.points, samples.ray, samples.present, before, axes_of(box, forward)),
            *(earlier, weights, over_samples, ndc, kept_gradient(forward)),
        )
        return MotionSum(total, terms)
    points, q, weight, ray, present = samples
    coords = to_grid(q, box, shape_of(forward))
    returned = q + interpolate(forward, coords, gradient=kept_gradient(forward))
    missed = torch.where(present, cycle_error(points.detach(), returned), 0.0)
    cycle = missed.sum() / present.sum().clamp(min=1)
    flow = cycle.new_zeros(())
    if earlier is not None:
        counts_flow = present & earlier.valid[ray]
        q = torch.where(counts_flow[:, None], q, 0.0)
        moved = q + interpolate(before.detach(), to_grid(q, box, shape_of(before)))
        projected = _project(_to_world(moved, ndc), earlier, earlier.previous[earlier.image[ray]])
        count = 2 * counts_flow.sum() if over_samples else earlier.valid.sum()
        induced, counted = projected - earlier.pixel[ray], torch.where(counts_flow, weight, 0.0)
        flow = flow_error(counted, induced, earlier.vectors[ray], count)
    total = weights[0] * cycle + weights[1] * flow
    return MotionSum(total, torch.stack([cycle, flow]).detach())


def _to_world(points: Tensor, ndc: Triple | None) -> Tensor:
    if ndc is None:
        return points
    slope_x, slope_y, near = ndc
    x, y, z = points.unbind(-1)
    gap = z - 1
    depth = 2 * near / torch.where(gap == 0, -BEFORE_INFINITY, gap)
    return torch.stack([-x * depth / slope_x, -y * depth / slope_y, depth], dim=-1)


def _project(points: Tensor, earlier: SeenEarlier, camera: Tensor) -> Tensor:
    """Pixels (K, 2) of world points (K, 3) in the images ``camera`` (K,)."""
    pose = earlier.poses[camera]
    local = (pose[:, :, :3] * (points - pose[:, :, 3])[:, :, None]).sum(dim=-2)
    x, y, z = local.unbind(-1)
    depth = torch.where(z.abs() < NEAREST, NEAREST, -z)
    pixel: Tensor = torch.stack([x / depth, -y / depth], dim=-1) * earlier.focal[camera]
    return pixel + earlier.center[camera]

"""The cycle and the flow loss through a grid of displacements, and their gradients.

See docs/method.md#deformation-losses; ``devrf.methods.devrf.losses`` has the definitions. A thread
looks at one sample.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import BEFORE_INFINITY, NormalizedDevice
from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.displacement import Warp, follows, slope_of_warped, warp_of, warped
from devrf.kernels.pixels import Axis, Xy
from devrf.kernels.runtime import launch
from devrf.kernels.trilinear import add_to_grid
from devrf.ops.march import Samples
from devrf.ops.trilinear import shape_of


def cycle_error(
    samples: Samples, displacement: Tensor, box: Box, *, zero_outside_box: bool
) -> Tensor:
    """mean_i ½ |x_i − (q_i + Δ(q_i))|² () of Δ (X, Y, Z, 3) over ``box``."""
    points, canonical = samples.points, samples.canonical.detach()
    warp = warp_of(box, shape_of(displacement), zero_outside_box)
    errors = torch.empty(len(points), device=points.device)
    gradients = torch.empty_like(points), torch.empty_like(points)
    inputs = [warp, points, canonical, displacement.detach(), errors, *gradients]
    launch(cycle_kernel, len(points), inputs, points.device)

    def adjoint(gradient: Tensor) -> tuple[Tensor, Tensor]:
        of_canonical, moved = torch._foreach_mul(gradients, gradient)
        of_displacement = torch.zeros_like(displacement)
        add_to_grid(of_displacement, canonical, moved, box)
        return of_canonical, of_displacement

    mean = errors.mean() if len(errors) else errors.sum()
    return with_adjoint((mean,), (samples.canonical, displacement), adjoint)[0]


def flow_error(
    samples: Samples,
    displacement: Tensor | None,
    box: Box,
    *,
    zero_outside_box: bool,
    cameras: Cameras,
    previous: Tensor,
    image: Tensor,
    pixel: Tensor,
    flow: Tensor,
    valid: Tensor,
    ndc: NormalizedDevice | None,
    by_ray: bool,
) -> Tensor:
    """(1/M) Σ_i w_i m_i |π(q_i + Δ(q_i)) − u − φ|₁ (), M as of ``losses.flow``.

    Args:
        samples: of R rays, in world space or ``ndc``.
        displacement: (X, Y, Z, 3) Δ, which gets no gradient; None: nothing moves.
        box: of the displacements.
        zero_outside_box: whether Δ is 0 outside.
        cameras: with π.
        previous: (N,) int64, the image whose camera is π, of each image.
        image: (R,) int64, the image of each ray.
        pixel: (R, 2) u.
        flow: (R, 2) φ.
        valid: (R,) bool m.
        ndc: the samples' space; None: the world.
        by_ray: whether M is the number of valid rays, or twice that of their samples.
    """
    canonical, weight = samples.canonical.detach(), samples.weight.detach()
    shape = None if displacement is None else shape_of(displacement)
    moves = weight.new_empty(0, 3) if displacement is None else displacement.detach()
    slopes = wp.vec3() if ndc is None else wp.vec3(*ndc.slopes, ndc.near)
    parts = torch.empty(len(weight), 2, device=weight.device)
    gradients = torch.empty_like(canonical), torch.empty_like(weight)
    inputs = [warp_of(box, shape, zero_outside_box), slopes, canonical, weight, samples.ray]
    inputs += [moves, cameras.camera_to_world, cameras.focal, cameras.center]
    inputs += [previous, image, pixel, flow, valid, parts, *gradients]
    launch(flow_kernel, len(weight), inputs, weight.device)
    total, count = parts.sum(dim=0)
    count = (valid.sum().float() if by_ray else count).clamp(min=1)
    (error,) = with_adjoint(
        (total / count,),
        (samples.canonical, samples.weight),
        lambda gradient: torch._foreach_mul(gradients, gradient / count),
    )
    return error


@wp.kernel(module="unique", enable_backward=False)
def cycle_kernel(
    first: int,
    warp: Warp,
    points: wp.array(dtype=wp.vec3),
    canonical: wp.array(dtype=wp.vec3),
    displacements: wp.array(dtype=wp.vec3),
    error: wp.array(dtype=float),
    of_canonical: wp.array(dtype=wp.vec3),
    of_moved: wp.array(dtype=wp.vec3),
):
    """½ |x − (q + Δ(q))|² of each sample, and the mean's gradients of q and of Δ(q)."""
    sample = first + wp.tid()
    q = canonical[sample]
    missed = warped(warp, displacements, q) - points[sample]
    error[sample] = 0.5 * wp.dot(missed, missed)
    given = missed / float(points.shape[0])
    of_canonical[sample] = slope_of_warped(warp, displacements, q, given)
    of_moved[sample] = wp.where(follows(warp, q), given, wp.vec3())


@wp.func
def depth_in_world(ndc: wp.vec3, point: wp.vec3):
    """z of a point of NDC in the reference camera's axes."""
    gap = point[2] - 1.0
    if gap == 0.0:
        gap = -wp.static(BEFORE_INFINITY)
    return 2.0 * ndc[2] / gap


@wp.func
def seen_by(ndc: wp.vec3, poses: wp.array(dtype=Axis), camera: int, point: wp.vec3):
    """A point in the axes of a camera: x right, y up, z backward."""
    world = point
    if ndc[2] > 0.0:
        depth = depth_in_world(ndc, point)
        world = wp.vec3(-point[0] * depth / ndc[0], -point[1] * depth / ndc[1], depth)
    local = wp.vec3()
    for axis in range(3):
        pose = poses[3 * camera + axis]
        local += wp.vec3(pose[0], pose[1], pose[2]) * (world[axis] - pose[3])
    return local


@wp.func
def slope_of_seen(
    ndc: wp.vec3, poses: wp.array(dtype=Axis), camera: int, point: wp.vec3, given: wp.vec3
):
    """The gradient of a point from that of its place in the axes of a camera."""
    world = wp.vec3()
    for axis in range(3):
        pose = poses[3 * camera + axis]
        world[axis] = wp.dot(wp.vec3(pose[0], pose[1], pose[2]), given)
    if ndc[2] == 0.0:
        return world
    depth = depth_in_world(ndc, point)
    x = -world[0] / ndc[0]
    y = -world[1] / ndc[1]
    along = point[0] * x + point[1] * y + world[2]
    squeezed = -depth * depth / (2.0 * ndc[2])
    if point[2] == 1.0:
        squeezed = 0.0
    return wp.vec3(x * depth, y * depth, along * squeezed)


@wp.func
def signum(x: float):
    """−1, 0 or 1, as torch's gradient of the absolute value."""
    return wp.where(x == 0.0, 0.0, wp.sign(x))


@wp.kernel(module="unique", enable_backward=False)
def flow_kernel(
    first: int,
    warp: Warp,
    ndc: wp.vec3,
    canonical: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=float),
    rays: wp.array(dtype=wp.int64),
    displacements: wp.array(dtype=wp.vec3),
    poses: wp.array(dtype=Axis),
    focals: wp.array(dtype=Xy),
    centers: wp.array(dtype=Xy),
    previous: wp.array(dtype=wp.int64),
    images: wp.array(dtype=wp.int64),
    pixels: wp.array(dtype=Xy),
    flows: wp.array(dtype=Xy),
    valid: wp.array(dtype=wp.bool),
    part: wp.array(dtype=Xy),
    of_canonical: wp.array(dtype=wp.vec3),
    of_weight: wp.array(dtype=float),
):
    """w |π − u − φ|₁ of each sample, and 2; and the sum's gradients of q and of w.

    All are 0 where the flow of a sample's ray is not valid.
    """
    sample = first + wp.tid()
    ray = int(rays[sample])
    part[sample] = Xy(0.0, 0.0)
    of_canonical[sample] = wp.vec3()
    of_weight[sample] = 0.0
    if valid[ray]:
        camera = int(previous[int(images[ray])])
        q = canonical[sample]
        moved = warped(warp, displacements, q)
        local = seen_by(ndc, poses, camera, moved)
        depth = -local[2]
        behind = wp.abs(depth) < 1.0e-8  # as in ``Cameras.project``
        if behind:
            depth = 1.0e-8
        focal = focals[camera]
        missed = Xy(local[0] / depth * focal[0], -local[1] / depth * focal[1])
        missed += centers[camera] - pixels[ray] - flows[ray]
        error = wp.abs(missed[0]) + wp.abs(missed[1])
        part[sample] = Xy(weight[sample] * error, 2.0)
        of_weight[sample] = error
        x = weight[sample] * signum(missed[0]) * focal[0] / depth
        y = -weight[sample] * signum(missed[1]) * focal[1] / depth
        z = wp.where(behind, 0.0, (x * local[0] + y * local[1]) / depth)
        of_moved = slope_of_seen(ndc, poses, camera, moved, wp.vec3(x, y, z))
        of_canonical[sample] = slope_of_warped(warp, displacements, q, of_moved)

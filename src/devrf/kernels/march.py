"""The march along rays: samples in occupied space, warped and composited, and its adjoint.

See docs/method.md#rays, #warp, #density and #compositing. A thread follows one ray; empty space is
skipped by the distances to occupied cells.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from devrf.geometry.contraction import INFINITY, ContractedRays, ContractedSpace
from devrf.geometry.rays import PARALLEL, Rays
from devrf.kernels.grid import (
    Grid,
    add_cell,
    cell,
    coordinates,
    grid_over,
    inside,
    interpolate_cell,
    slope,
)
from devrf.kernels.runtime import (
    GRAIN_OF_RAYS,
    cached_kernel,
    empty_structs,
    is_supported,
    launch,
    row_type,
)
from devrf.ops import march as definition
from devrf.ops.compositing import LEAST_MASS
from devrf.ops.march import EXIT, STOP, MarchInputs, Samples
from devrf.ops.trilinear import shape_of

# The most half edges of the inner box that a ray moves along any axis while its distance grows by
# that of one half edge along its fastest axis; more in a thick shell, and if several axes are about
# as fast.
CONTRACTED_PACE = 3.0
# A row of the grid of raw densities.
Density = row_type(1)


def march(rays: Rays, inputs: MarchInputs) -> Samples:
    """As :func:`devrf.ops.march.march`, differentiable once.

    A leaf of densities that has a gradient is added to there.
    """
    if not is_supported(rays.origins):
        return definition.march(rays, inputs)
    kept = inputs.density.grad if inputs.density.is_leaf else None
    results = _March.apply(  # type: ignore[no-untyped-call]
        inputs.density, inputs.displacement, rays, inputs, kept
    )
    return Samples(*results)


class _March(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        density: Tensor,
        displacement: Tensor | None,
        rays: Rays,
        inputs: MarchInputs,
        kept: Tensor | None,
    ) -> tuple[Tensor, ...]:
        device = density.device
        geometry = _geometry(rays, inputs)
        limits = inputs.range
        # Room for all of a ray's samples, as the host knows it: the number of visible ones is
        # known afterwards. Memory that is not written to costs a CPU nothing.
        longest = rays.longest(limits.box.low, limits.box.high, limits.near, limits.far)
        room = 2 + int(longest / limits.step * (1 + 1e-5))
        lines = empty_structs(Ray, len(rays), device)
        visible = empty_structs(VisibleSample, len(rays) * room, device)
        visible_start = torch.empty(len(rays), dtype=torch.int32, device=device)
        visible_count = torch.empty_like(visible_start)
        significant_count = torch.empty_like(visible_start)
        transmittance = torch.empty(len(rays), device=device)
        # Straight rays have no course: their origins stand in for it.
        course = rays.course if isinstance(rays, ContractedRays) else rays.origins
        # Without displacements kernels get an array that they do not read.
        moves = density.new_empty(0, 3) if displacement is None else displacement.contiguous()
        arguments = [each.contiguous() for each in (rays.origins, rays.directions, course)]
        arguments = [
            geometry,
            *arguments,
            limits.near,
            limits.far,
            limits.distances.cells.flatten(),
        ]
        arguments += [density.contiguous(), moves, room, int(device.type == "cpu"), lines]
        arguments += [visible_start, visible, visible_count, significant_count, transmittance]
        kernel = march_kernel(isinstance(rays, ContractedRays))
        launch(kernel, len(rays), arguments, device, grain=GRAIN_OF_RAYS)

        stop = significant_count.cumsum(0)
        length = int(stop[-1]) if len(rays) else 0
        ray = torch.empty(length, dtype=torch.int64, device=device)
        distance = torch.empty(length, device=device)
        points = torch.empty(length, 3, device=device)
        canonical = torch.empty(length, 3, device=device)
        weight = torch.empty(length, device=device)
        depth = torch.empty(len(rays), device=device)
        arguments = [
            geometry,
            lines,
            visible_start,
            visible,
            visible_count,
            significant_count,
            stop,
        ]
        arguments += [ray, distance, points, canonical, weight, depth]
        launch(keep_significant_kernel, len(rays), arguments, device)

        fixed = displacement is None or not displacement.requires_grad
        given = [ray, distance, points, depth, stop]
        ctx.mark_non_differentiable(*given, *([canonical] if fixed else []))
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(density, moves, visible_start, visible_count, stop, transmittance)
        ctx.geometry, ctx.lines, ctx.visible = geometry, lines, visible
        ctx.kept = kept
        return ray, distance, points, canonical, weight, transmittance, depth, stop

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        density, moves, visible_start, visible_count, stop, transmittance = ctx.saved_tensors
        device = density.device
        # A kernel does not read an array of nothing.
        given = [
            density.new_empty((0, 3) if k == 0 else 0) if each is None else each.contiguous()
            for k, each in enumerate(gradients[3:6])
        ]
        # The gradients take the place of the samples: they are not needed again.
        assert ctx.visible is not None, "a march has one backward pass"
        of_rays = [ctx.geometry, ctx.lines, visible_start, ctx.visible, visible_count]
        arguments = [*of_rays, density.contiguous(), stop, *given, transmittance]
        launch(adjoint_kernel, len(visible_count), arguments, device, grain=GRAIN_OF_RAYS)

        of_density = of_displacement = None
        into = [density.new_empty(0, 1), density.new_empty(0, 3)]
        if ctx.needs_input_grad[0]:
            of_density = torch.zeros_like(density) if ctx.kept is None else None
            into[0] = ctx.kept if of_density is None else of_density
        if ctx.needs_input_grad[1]:
            into[1] = of_displacement = torch.zeros_like(moves)
        arguments = [*of_rays, moves, *into]
        launch(scatter_kernel, len(visible_count), arguments, device, grain=None)
        ctx.visible = None
        return of_density, of_displacement, None, None, None


def _geometry(rays: Rays, inputs: MarchInputs) -> Geometry:
    distances = inputs.range.distances
    motion = None
    if inputs.displacement is not None and inputs.motion_box is not None:
        motion = grid_over(inputs.motion_box, shape_of(inputs.displacement))
    return geometry_of(
        density=grid_over(inputs.range.box, shape_of(inputs.density)),
        occupancy=grid_over(distances.box, shape_of(distances.cells)),
        motion=motion,
        zero_outside_box=inputs.zero_outside_box,
        space=rays.space if isinstance(rays, ContractedRays) else None,
        step=inputs.range.step,
        shift=inputs.shift,
        delta=inputs.delta,
        threshold=inputs.threshold,
    )


@lru_cache(maxsize=64)
def geometry_of(
    *,
    density: Grid,
    occupancy: Grid,
    motion: Grid | None,
    zero_outside_box: bool,
    space: ContractedSpace | None,
    step: float,
    shift: float,
    delta: float,
    threshold: float,
) -> Geometry:
    """Grids and settings of a march; with a ``space``, of rays in contracted space."""
    geometry = Geometry()
    geometry.density = density
    geometry.occupancy = occupancy
    if motion is not None:
        geometry.moves = 1
        geometry.motion = motion
        geometry.zero_outside_box = int(zero_outside_box)
    if space is not None:
        inner = space.inner()
        geometry.contracted = 1
        geometry.center = wp.vec3(*inner.middle)
        geometry.half = wp.vec3(*(edge / 2 for edge in inner.size))
        geometry.shell = space.shell
    geometry.step = step
    geometry.shift = shift
    geometry.delta = delta
    geometry.threshold = threshold
    # α ≥ threshold where v + b ≥ softplus⁻¹(τ / δ).
    geometry.faintest = -math.inf
    if threshold > 0:
        tau = -math.log1p(-threshold)
        geometry.faintest = math.log(math.expm1(tau / delta)) - shift
    return geometry


@wp.struct
class Geometry:
    """Grids and settings of a march.

    Attributes:
        density: the grid of raw densities.
        occupancy: the grid of distances to occupied cells.
        motion: the grid of displacements.
        moves: 1 where there are displacements, else 0.
        zero_outside_box: 1 where nothing moves outside the motion's grid, else 0.
        contracted: 1 in contracted space, else 0.
        center: of the contracted space's inner box.
        half: its half edges.
        shell: its shell's thickness in half edges.
        faintest: the raw density whose opacity is the threshold.
        step, shift, delta, threshold: as of a ``MarchInputs`` and its ``MarchRange``.
    """

    density: Grid
    occupancy: Grid
    motion: Grid
    moves: int
    zero_outside_box: int
    contracted: int
    center: wp.vec3
    half: wp.vec3
    shell: float
    faintest: float
    step: float
    shift: float
    delta: float
    threshold: float


@wp.struct
class VisibleSample:
    """A sample at a distance along its ray, and at q in canonical space: τ, and w = T α."""

    distance: float
    canonical: wp.vec3
    tau: float
    weight: float


@wp.struct
class Ray:
    """A ray: in the fields' space, or if it is contracted in the world, with its course.

    It has ``count`` samples from the distance ``entry`` on, and moves by a cell of the occupancy in
    ``samples_per_cell`` or more. Its k-th sample is at ``start`` + k · ``pace`` in the occupancy's
    grid coordinates; in contracted space these mean nothing.
    """

    origin: wp.vec3
    direction: wp.vec3
    course: wp.vec3
    entry: float
    count: int
    start: wp.vec3
    pace: wp.vec3
    samples_per_cell: float


@wp.func
def position(geometry: Geometry, ray: Ray, distance: float):
    """The point at a distance along a ray; in contracted space as ``ContractedRays.at``."""
    if geometry.contracted == 0:
        return ray.origin + ray.direction * distance
    world = distance
    y = ray.course[0] + ray.course[1] * distance
    if wp.abs(y) > 1.0:
        disparity = wp.max(1.0 - (wp.abs(y) - 1.0) / ray.course[2], wp.static(INFINITY))
        world = (wp.sign(y) / disparity - ray.course[0]) / ray.course[1]
    point = ray.origin + ray.direction * world
    u = wp.cw_div(point - geometry.center, geometry.half)
    m = wp.max(wp.abs(u))
    if m > 1.0:
        squeezed = (1.0 + geometry.shell - geometry.shell / m) / m
        point = geometry.center + wp.cw_mul(geometry.half, u) * squeezed
    return point


@wp.func
def own_distance(course: wp.vec3, world: float):
    """The distance along a contracted ray of a distance in the world, as in ``ContractedRays``."""
    x = course[0] + course[1] * world
    if wp.abs(x) <= 1.0:
        return world
    y = wp.sign(x) * (1.0 + course[2] * (1.0 - 1.0 / wp.abs(x)))
    return (y - course[0]) / course[1]


@wp.func
def grid_position(geometry: Geometry, ray: Ray, k: int):
    """The occupancy's grid coordinates of a ray's k-th sample."""
    point = position(geometry, ray, ray.entry + float(k) * geometry.step)
    return coordinates(geometry.occupancy, point)


@wp.func
def straight_grid_position(geometry: Geometry, ray: Ray, k: int):
    """The same in straight space, by one multiplication."""
    return ray.start + ray.pace * float(k)


@wp.func
def clearance(grid: Grid, distances: wp.array(dtype=wp.uint8), at: wp.vec3):
    """Cells to the nearest occupied one, at least; 0 in an occupied cell."""
    i = int(wp.rint(at[0]))
    j = int(wp.rint(at[1]))
    k = int(wp.rint(at[2]))
    if i < 0 or j < 0 or k < 0 or i >= grid.x or j >= grid.y or k >= grid.z:
        return 1
    return int(distances[i * grid.next_x + j * grid.next_y + k * grid.next_z])


@wp.func
def warped(geometry: Geometry, displacements: wp.array(dtype=wp.vec3), point: wp.vec3):
    """q = x + Δ(x)."""
    if geometry.moves == 0:
        return point
    if geometry.zero_outside_box == 1:
        if wp.min(inside(geometry.motion, point)) == 0.0:
            return point
    row, fraction = cell(geometry.motion, point)
    return point + interpolate_cell(displacements, geometry.motion, row, fraction)


@wp.func
def softplus(x: float):
    """log(1 + exp(x)), exact where it is small, too."""
    if x > 15.0:
        return x
    e = wp.exp(x)
    if e < 0.01:
        return e * (1.0 - e * (0.5 - e / 3.0))
    return wp.log(1.0 + e)


@wp.func
def opacity(tau: float):
    """α = 1 − exp(−τ), exact where it is small, too."""
    if tau < 0.01:
        return tau * (1.0 - tau * (0.5 - tau / 6.0))
    return 1.0 - wp.exp(-tau)


@wp.func
def entering(
    geometry: Geometry,
    origin: wp.vec3,
    direction: wp.vec3,
    course: wp.vec3,
    near: float,
    far: float,
):
    """A ray, with entry and count as of ``steps_through``: samples in empty space or not."""
    ray = Ray()
    ray.origin = origin
    ray.direction = direction
    ray.course = course
    ray.entry = near
    leave = far
    cells = float(0.0)
    if geometry.contracted == 1:
        ray.entry = own_distance(ray.course, near)
        leave = own_distance(ray.course, far)
        slopes = wp.abs(wp.cw_div(ray.direction, geometry.half))
        fastest = ray.course[1]
        cells = 2.0 * (slopes[0] + slopes[1] + slopes[2]) - fastest
        cells = wp.max(cells, wp.max(wp.static(CONTRACTED_PACE), geometry.shell) * fastest)
        cells *= wp.max(wp.cw_mul(geometry.half, geometry.occupancy.scale)) * geometry.step
    else:
        for axis in range(3):
            along = ray.direction[axis]
            if wp.abs(along) < wp.static(PARALLEL):
                along = wp.static(PARALLEL)
            to_low = (geometry.density.low[axis] - ray.origin[axis]) / along
            to_high = (geometry.density.high[axis] - ray.origin[axis]) / along
            ray.entry = wp.max(ray.entry, wp.min(to_low, to_high))
            leave = wp.min(leave, wp.max(to_low, to_high))
        ray.start = coordinates(geometry.occupancy, ray.origin + ray.direction * ray.entry)
        ray.pace = wp.cw_mul(ray.direction, geometry.occupancy.scale) * geometry.step
        cells = wp.max(wp.abs(ray.pace))
    # A little less: positions are rounded.
    ray.samples_per_cell = 0.999 / wp.max(cells, 1.0e-9)
    ray.count = 0
    if leave >= ray.entry:
        ray.count = 1 + int(wp.floor((leave - ray.entry) / geometry.step + wp.static(EXIT)))
    return ray


@cached_kernel
def march_kernel(contracted: bool) -> wp.Kernel:
    """The march in straight or in contracted space; one for both takes a third longer."""
    coordinates_of = grid_position if contracted else straight_grid_position

    @wp.kernel(module="unique", enable_backward=False)
    def march(
        first: int,
        geometry: Geometry,
        origins: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        courses: wp.array(dtype=wp.vec3),
        near: float,
        far: float,
        distances: wp.array(dtype=wp.uint8),
        density: wp.array(dtype=Density),
        displacements: wp.array(dtype=wp.vec3),
        room: int,
        in_order: int,
        rays: wp.array(dtype=Ray),
        visible_start: wp.array(dtype=int),
        visible: wp.array(dtype=VisibleSample),
        visible_count: wp.array(dtype=int),
        significant_count: wp.array(dtype=int),
        transmittance: wp.array(dtype=float),
    ):
        """Rays, τ_i and w_i = T_i α_i of each ray's visible samples, and T_end.

        On a CPU a part of a launch follows its rays ``in_order``, one after another in one thread:
        each ray's samples begin where those of the ray before end, close together in memory. Else
        each ray has its own ``room``.
        """
        number = first + wp.tid()
        ray = entering(geometry, origins[number], directions[number], courses[number], near, far)
        ray.count = wp.min(ray.count, room)
        rays[number] = ray
        start = number * room
        if in_order == 1 and number > first:
            start = visible_start[number - 1] + visible_count[number - 1]
        visible_start[number] = start
        count = int(0)
        significant = int(0)
        remaining = float(1.0)
        k = int(0)
        while k < ray.count:
            cells = clearance(geometry.occupancy, distances, coordinates_of(geometry, ray, k))
            if cells > 0:
                # In cells - 1 cells' way the nearest cell changes by less than that and one.
                k += int(float(cells - 1) * ray.samples_per_cell)
            else:
                distance = ray.entry + float(k) * geometry.step
                point = position(geometry, ray, distance)
                canonical = warped(geometry, displacements, point)
                row, fraction = cell(geometry.density, canonical)
                raw = interpolate_cell(density, geometry.density, row, fraction)[0]
                if raw >= geometry.faintest:
                    sample = VisibleSample()
                    sample.distance = distance
                    sample.canonical = canonical
                    sample.tau = softplus(raw + geometry.shift) * geometry.delta
                    sample.weight = remaining * opacity(sample.tau)
                    visible[start + count] = sample
                    count += 1
                    if sample.weight >= geometry.threshold:
                        significant += 1
                    remaining -= sample.weight
                    if remaining < wp.static(STOP):
                        k = ray.count
            k += 1
        visible_count[number] = count
        significant_count[number] = significant
        transmittance[number] = remaining

    return march


@wp.kernel(module="unique", enable_backward=False)
def keep_significant_kernel(
    first: int,
    geometry: Geometry,
    rays: wp.array(dtype=Ray),
    visible_start: wp.array(dtype=int),
    visible: wp.array(dtype=VisibleSample),
    visible_count: wp.array(dtype=int),
    significant_count: wp.array(dtype=int),
    stops: wp.array(dtype=wp.int64),
    result_ray: wp.array(dtype=wp.int64),
    result_distance: wp.array(dtype=float),
    result_points: wp.array(dtype=wp.vec3),
    result_canonical: wp.array(dtype=wp.vec3),
    result_weight: wp.array(dtype=float),
    result_depth: wp.array(dtype=float),
):
    """The visible samples of enough weight, without gaps, each ray's up to its stop; its depth."""
    number = first + wp.tid()
    count = visible_count[number]
    result_depth[number] = 0.0
    if count == 0:
        return
    ray = rays[number]
    start = visible_start[number]
    into = int(stops[number]) - significant_count[number]
    mass = float(0.0)
    reached = float(0.0)
    for k in range(count):
        sample = visible[start + k]
        if sample.weight >= geometry.threshold:
            mass += sample.weight
            reached += sample.weight * sample.distance
            result_ray[into] = wp.int64(number)
            result_distance[into] = sample.distance
            result_points[into] = position(geometry, ray, sample.distance)
            result_canonical[into] = sample.canonical
            result_weight[into] = sample.weight
            into += 1
    result_depth[number] = reached / wp.max(mass, wp.static(LEAST_MASS))


@wp.kernel(module="unique", enable_backward=False)
def adjoint_kernel(
    first: int,
    geometry: Geometry,
    rays: wp.array(dtype=Ray),
    visible_start: wp.array(dtype=int),
    visible: wp.array(dtype=VisibleSample),
    visible_count: wp.array(dtype=int),
    density: wp.array(dtype=Density),
    significant_stop: wp.array(dtype=wp.int64),
    given_canonical: wp.array(dtype=wp.vec3),
    given_weight: wp.array(dtype=float),
    given_transmittance: wp.array(dtype=float),
    transmittance: wp.array(dtype=float),
):
    """∂L/∂v and ∂L/∂Δ of visible samples from the gradients of the march's results.

    They take the place of τ and, where there are displacements, of q. The gradients of results that
    have none are empty arrays.

    Back to front ∂L/∂τ_i = ∂L/∂w_i T_i exp(−τ_i) − Σ_{j>i} ∂L/∂w_j w_j − ∂L/∂T_end T_end.
    """
    number = first + wp.tid()
    count = visible_count[number]
    if count == 0:
        return
    ray = rays[number]
    start = visible_start[number]
    significant = int(significant_stop[number])
    after = transmittance[number]
    behind = float(0.0)
    if given_transmittance.shape[0] > 0:
        behind = given_transmittance[number] * after
    for back in range(count):
        sample = visible[start + count - 1 - back]
        tau = sample.tau
        weight = sample.weight
        slope_of_tau = -behind
        slope_of_canonical = wp.vec3()
        if weight >= geometry.threshold:
            significant -= 1
            if given_weight.shape[0] > 0:
                slope_of_tau += given_weight[significant] * after
                behind += given_weight[significant] * weight
            if given_canonical.shape[0] > 0:
                slope_of_canonical = given_canonical[significant]
        # T_i, from T_i exp(−τ_i) or from w_i = T_i α_i, whichever is not a small number's ratio.
        if tau < 1.0:
            after *= wp.exp(tau)
        else:
            after = weight / opacity(tau)
        # ∂τ/∂v = δ · sigmoid(v + b), and sigmoid = 1 − exp(−softplus).
        slope_of_raw = slope_of_tau * geometry.delta * opacity(tau / geometry.delta)
        sample.tau = slope_of_raw
        if geometry.moves == 1:
            row, fraction = cell(geometry.density, sample.canonical)
            change = slope(density, Density(slope_of_raw), geometry.density, row, fraction)
            slope_of_canonical += wp.cw_mul(change, inside(geometry.density, sample.canonical))
            if geometry.zero_outside_box == 1:
                point = position(geometry, ray, sample.distance)
                slope_of_canonical *= wp.min(inside(geometry.motion, point))
            sample.canonical = slope_of_canonical
        visible[start + count - 1 - back] = sample


@wp.kernel(module="unique", enable_backward=False)
def scatter_kernel(
    first: int,
    geometry: Geometry,
    rays: wp.array(dtype=Ray),
    visible_start: wp.array(dtype=int),
    visible: wp.array(dtype=VisibleSample),
    visible_count: wp.array(dtype=int),
    displacements: wp.array(dtype=wp.vec3),
    of_density: wp.array(dtype=Density),
    of_displacement: wp.array(dtype=wp.vec3),
):
    """The gradients that :func:`adjoint_kernel` left, added to those of the grids that have one.

    On a CPU in one thread, in the order of the rays.
    """
    number = first + wp.tid()
    start = visible_start[number]
    for place in range(start, start + visible_count[number]):
        sample = visible[place]
        point = position(geometry, rays[number], sample.distance)
        if of_density.shape[0] > 0:
            canonical = warped(geometry, displacements, point)
            row, fraction = cell(geometry.density, canonical)
            add_cell(of_density, geometry.density, row, fraction, Density(sample.tau))
        if of_displacement.shape[0] > 0:
            row, fraction = cell(geometry.motion, point)
            add_cell(of_displacement, geometry.motion, row, fraction, sample.canonical)

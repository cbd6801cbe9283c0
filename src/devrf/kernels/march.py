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

from devrf.geometry.contraction import INFINITY, ContractedRays, ContractedSpace
from devrf.geometry.rays import PARALLEL, Rays
from devrf.kernels.adjoint import with_adjoint
from devrf.kernels.compositing import first_of
from devrf.kernels.displacement import Warp, follows, warp_of, warped
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

    Where ``density`` is a leaf that has a gradient (``GridAdam.make_gradients``), the backward pass
    adds to that tensor and gives autograd none: hooks of the leaf see nothing.
    """
    if not is_supported(rays.origins):
        return definition.march(rays, inputs)
    density, displacement, limits = inputs.density, inputs.displacement, inputs.range
    device, count = density.device, len(rays)
    grad = density.grad if density.is_leaf else None
    geometry = _geometry(rays, inputs)
    # Room for all of a ray's samples, as the host knows it: the number of visible ones is known
    # afterwards. Memory that is not written to costs a CPU nothing.
    longest = rays.longest(limits.box.low, limits.box.high, limits.near, limits.far)
    room = 2 + int(longest / limits.step * (1 + 1e-5))
    followed = empty_structs(Ray, count, device)
    visible = empty_structs(VisibleSample, count * room, device)
    significant = torch.empty(count, dtype=torch.int32, device=device)
    transmittance = torch.empty(count, device=device)
    # Straight rays have no course: their origins stand in for it.
    course = rays.course if isinstance(rays, ContractedRays) else rays.origins
    given = [each.contiguous() for each in (rays.origins, rays.directions, course)]
    # Without displacements kernels get an array that they do not read.
    moves = density.new_empty(0, 3) if displacement is None else displacement.detach().contiguous()
    raw = density.detach().contiguous()
    arguments = [geometry, *given, limits.near, limits.far, limits.distances.cells.flatten()]
    arguments += [raw, moves, room, int(device.type == "cpu")]
    arguments += [followed, visible, significant, transmittance]
    kernel = march_kernel(isinstance(rays, ContractedRays))
    launch(kernel, count, arguments, device, grain=GRAIN_OF_RAYS)

    stop = significant.cumsum(0)
    length = int(stop[-1]) if count else 0
    ray = torch.empty(length, dtype=torch.int64, device=device)
    distance = torch.empty(length, device=device)
    points = torch.empty(length, 3, device=device)
    canonical = torch.empty_like(points)
    weight = torch.empty_like(distance)
    depth = torch.empty(count, device=device)
    arguments = [geometry, followed, visible, stop, ray, distance, points, canonical, weight, depth]
    launch(keep_significant_kernel, count, arguments, device)

    def adjoint(
        of_weight: Tensor, of_end: Tensor, of_canonical: Tensor | None = None
    ) -> tuple[Tensor | None, Tensor | None]:
        nonlocal visible
        assert visible is not None, "a march has one backward pass"
        if of_canonical is None:
            of_canonical = density.new_empty(0, 3)
        arguments = [geometry, followed, visible, raw, stop]
        arguments += [of_canonical, of_weight, of_end, transmittance]
        launch(adjoint_kernel, count, arguments, device, grain=GRAIN_OF_RAYS)
        # A kernel does not read an array of nothing.
        into = [density.new_empty(0, 1), density.new_empty(0, 3)]
        of_density = of_displacement = None
        if density.requires_grad:
            of_density = torch.zeros_like(raw) if grad is None else None
            into[0] = grad if of_density is None else of_density
        if displacement is not None and displacement.requires_grad:
            into[1] = of_displacement = torch.zeros_like(moves)
        arguments = [geometry, followed, visible, moves, *into]
        launch(scatter_kernel, count, arguments, device, grain=None)
        # The gradients have taken the place of the samples.
        visible = None
        return of_density, of_displacement

    learned, results = (density, displacement), (weight, transmittance)
    if displacement is not None and displacement.requires_grad:
        results = (*results, canonical)
    weight, end, *moved = with_adjoint(results, learned, adjoint)
    canonical = moved[0] if moved else canonical
    return Samples(ray, distance, points, canonical, weight, end, depth, stop)


def _geometry(rays: Rays, inputs: MarchInputs) -> Geometry:
    distances, displacement = inputs.range.distances, inputs.displacement
    shape = None if displacement is None else shape_of(displacement)
    return geometry_of(
        rays.space if isinstance(rays, ContractedRays) else None,
        density=grid_over(inputs.range.box, shape_of(inputs.density)),
        occupancy=grid_over(distances.box, shape_of(distances.cells)),
        warp=warp_of(inputs.displacement_box, shape, inputs.zero_outside_box),
        step=inputs.range.step,
        shift=inputs.shift,
        delta=inputs.delta,
        threshold=inputs.threshold,
    )


@lru_cache(maxsize=64)
def geometry_of(space: ContractedSpace | None, **settings: Any) -> Geometry:
    """A geometry with these attributes, of rays in contracted space if there is one; kept."""
    geometry = Geometry()
    for name, value in settings.items():
        setattr(geometry, name, value)
    if space is not None:
        inner = space.inner()
        geometry.contracted = 1
        geometry.center = wp.vec3(*inner.middle)
        geometry.half = wp.vec3(*(edge / 2 for edge in inner.size))
        geometry.shell = space.shell
    # α ≥ threshold where v + b ≥ softplus⁻¹(τ / δ).
    geometry.faintest = -math.inf
    if settings["threshold"] > 0:
        tau = -math.log1p(-settings["threshold"])
        geometry.faintest = math.log(math.expm1(tau / settings["delta"])) - settings["shift"]
    return geometry


@wp.struct
class Geometry:
    """Grids and settings of a march.

    Attributes:
        density: the grid of raw densities.
        occupancy: the grid of distances to occupied cells.
        warp: the warp.
        contracted: 1 in contracted space, else 0.
        center: of the contracted space's inner box.
        half: its half edges.
        shell: its shell's thickness in half edges.
        faintest: the raw density whose opacity is the threshold.
        step, shift, delta, threshold: as of a ``MarchInputs`` and its ``MarchRange``.
    """

    density: Grid
    occupancy: Grid
    warp: Warp
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
    ``samples_per_cell`` or more. Its k-th sample is at ``at_entry`` + k · ``pace`` in the grid
    coordinates of the occupancy; in contracted space these mean nothing. Its ``visible`` samples
    are in memory from ``start`` on.
    """

    origin: wp.vec3
    direction: wp.vec3
    course: wp.vec3
    entry: float
    count: int
    at_entry: wp.vec3
    pace: wp.vec3
    samples_per_cell: float
    start: int
    visible: int


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
    return ray.at_entry + ray.pace * float(k)


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
        ray.at_entry = coordinates(geometry.occupancy, ray.origin + ray.direction * ray.entry)
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
        visible: wp.array(dtype=VisibleSample),
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
        start = number * room
        if in_order == 1 and number > first:
            start = rays[number - 1].start + rays[number - 1].visible
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
                canonical = warped(geometry.warp, displacements, point)
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
        ray.start = start
        ray.visible = count
        rays[number] = ray
        significant_count[number] = significant
        transmittance[number] = remaining

    return march


@wp.kernel(module="unique", enable_backward=False)
def keep_significant_kernel(
    first: int,
    geometry: Geometry,
    rays: wp.array(dtype=Ray),
    visible: wp.array(dtype=VisibleSample),
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
    ray = rays[number]
    into = first_of(stops, number)
    mass = float(0.0)
    reached = float(0.0)
    for k in range(ray.start, ray.start + ray.visible):
        sample = visible[k]
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
    visible: wp.array(dtype=VisibleSample),
    density: wp.array(dtype=Density),
    significant_stop: wp.array(dtype=wp.int64),
    given_canonical: wp.array(dtype=wp.vec3),
    given_weight: wp.array(dtype=float),
    given_transmittance: wp.array(dtype=float),
    transmittance: wp.array(dtype=float),
):
    """∂L/∂v and ∂L/∂Δ of visible samples from the gradients of the march's results.

    They take the place of τ and, where there are displacements, of q. The gradient of q is an empty
    array where displacements are not learned.

    Back to front ∂L/∂τ_i = ∂L/∂w_i T_i exp(−τ_i) − Σ_{j>i} ∂L/∂w_j w_j − ∂L/∂T_end T_end.
    """
    number = first + wp.tid()
    ray = rays[number]
    last = ray.start + ray.visible - 1
    significant = int(significant_stop[number])
    after = transmittance[number]
    behind = given_transmittance[number] * after
    for back in range(ray.visible):
        sample = visible[last - back]
        tau = sample.tau
        weight = sample.weight
        slope_of_tau = -behind
        slope_of_canonical = wp.vec3()
        if weight >= geometry.threshold:
            significant -= 1
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
        if geometry.warp.moves == 1:
            row, fraction = cell(geometry.density, sample.canonical)
            change = slope(density, Density(slope_of_raw), geometry.density, row, fraction)
            slope_of_canonical += wp.cw_mul(change, inside(geometry.density, sample.canonical))
            if not follows(geometry.warp, position(geometry, ray, sample.distance)):
                slope_of_canonical = wp.vec3()
            sample.canonical = slope_of_canonical
        visible[last - back] = sample


@wp.kernel(module="unique", enable_backward=False)
def scatter_kernel(
    first: int,
    geometry: Geometry,
    rays: wp.array(dtype=Ray),
    visible: wp.array(dtype=VisibleSample),
    displacements: wp.array(dtype=wp.vec3),
    of_density: wp.array(dtype=Density),
    of_displacement: wp.array(dtype=wp.vec3),
):
    """The gradients that :func:`adjoint_kernel` left, added to those of the grids that have one.

    On a CPU in one thread, in the order of the rays.
    """
    ray = rays[first + wp.tid()]
    for k in range(ray.start, ray.start + ray.visible):
        sample = visible[k]
        point = position(geometry, ray, sample.distance)
        if of_density.shape[0] > 0:
            canonical = warped(geometry.warp, displacements, point)
            row, fraction = cell(geometry.density, canonical)
            add_cell(of_density, geometry.density, row, fraction, Density(sample.tau))
        if of_displacement.shape[0] > 0:
            row, fraction = cell(geometry.warp.grid, point)
            add_cell(of_displacement, geometry.warp.grid, row, fraction, sample.canonical)

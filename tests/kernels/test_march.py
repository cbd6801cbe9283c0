"""The march by kernels, and its gradients, against its definition in double precision."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedRays, ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.kernels.march import march
from devrf.ops import march as definition
from devrf.ops.march import STOP, MarchInputs, MarchRange, OccupancyDistances, Samples
from devrf.ops.trilinear import shape_of
from devrf.rendering.occupancy import Occupancy

SPACES = ["world", "ndc", "contracted"]
WORLD_BOX = Box((-1.0, -0.5, 0.0), (1.0, 1.5, 1.0))
NDC = NormalizedDevice(40, 30, (35.0, 33.0))
CONTRACTED = ContractedSpace((-1.0, -0.9, -1.2), (1.1, 0.8, 1.0), shell=0.7)
# Rounding does not decide what is so much clear of a border, in cells.
CLEAR = 1e-4


@dataclass(frozen=True)
class Setting:
    """Rays in a space, and how it is sampled."""

    rays: Rays
    range: MarchRange
    displacement_box: Box


def directed(origins: Tensor, targets: Tensor) -> Rays:
    """Rays from points to points, in single precision."""
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    return Rays(origins, directions, directions)


def setting(space: str, count: int, rng: torch.Generator, share: float = 0.4) -> Setting:
    """Random rays, some of which miss, and a random occupancy."""

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    if space == "world":
        rays, box = directed(2 * draw(count, 3), 0.8 * draw(count, 3)), WORLD_BOX
        displaced, limits = Box((-0.6, -0.3, 0.1), (0.7, 1.1, 0.8)), (0.06, 0.3, 6.0)
    elif space == "ndc":
        ahead = torch.tensor([0.0, 0.0, -4.0]) + 2.5 * draw(count, 3) * torch.tensor([1, 1, 0.3])
        rays, box = NDC.rays(directed(0.3 * draw(count, 3), ahead)), Box((-1.2,) * 3, (1.2,) * 3)
        displaced, limits = Box((-0.8, -0.7, -0.9), (0.6, 0.9, 0.8)), (0.031, 0.0, 1.0)
    else:
        rays, box = CONTRACTED.rays(directed(1.5 * draw(count, 3), draw(count, 3))), CONTRACTED.box
        displaced, limits = CONTRACTED.inner(), (0.06, 0.1, math.inf)
    occupancy = Occupancy(torch.rand(9, 8, 7, generator=rng) < share, box)
    return Setting(rays, MarchRange(box, occupancy.distances, *limits), displaced)


def inputs(
    given: Setting, rng: torch.Generator, *, moves: bool = True, zero_outside_box: bool = False
) -> MarchInputs:
    """Random densities and displacements; some rays end in front of what is behind."""
    return MarchInputs(
        given.range,
        density=5 * torch.randn(6, 7, 5, 1, generator=rng),
        shift=-1.5,
        delta=0.4,
        threshold=0.01,
        displacement=0.15 * torch.randn(4, 3, 5, 3, generator=rng) if moves else None,
        displacement_box=given.displacement_box if moves else None,
        zero_outside_box=zero_outside_box,
    )


def exact(something: MarchInputs, learned: bool = False) -> MarchInputs:
    """The same in double precision."""
    density, displacement = something.density.detach().double(), something.displacement
    if displacement is not None:
        displacement = displacement.detach().double().requires_grad_(learned)
    return replace(something, density=density.requires_grad_(learned), displacement=displacement)


def doubled(rays: Rays) -> Rays:
    return rays.to(torch.float64)


def clear_rays(rays: Rays, limits: MarchRange, moving: MarchInputs | None = None) -> Rays:
    """The rays none of whose samples is where rounding decides what it is.

    That is between two cells of the occupancy, on the faces of what moves, and, for what has moved,
    on a plane of the densities' grid, where slopes jump.
    """
    ray, _, points = definition.samples_in_box(doubled(rays), limits)
    at = limits.distances.box.to_grid(points, shape_of(limits.distances.cells))
    unclear = ((at - at.floor() - 0.5).abs() < CLEAR).any(dim=1)
    if moving is not None and moving.displacement is not None:
        canonical = definition.warped(points, exact(moving))
        at = limits.box.to_grid(canonical, shape_of(moving.density))
        unclear |= ((at - at.round()).abs() < CLEAR).any(dim=1) & (canonical != points).any(dim=1)
        at = moving.displacement_box.to_grid(points, shape_of(moving.displacement))
        last = torch.tensor(shape_of(moving.displacement)) - 1
        unclear |= torch.minimum(at.abs(), (at - last).abs()).amin(dim=1) < CLEAR
    kept = torch.ones(len(rays), dtype=torch.bool)
    kept[ray[unclear]] = False
    assert kept.float().mean() > 0.5
    return rays[kept]


def assert_same(ours: Samples, theirs: Samples, weights: float = 1e-5) -> None:
    """Exactly the same samples, at the same places, of the same weights to ``weights``."""
    assert torch.equal(ours.ray, theirs.ray) and torch.equal(ours.stop, theirs.stop)
    for name in ("distance", "points", "canonical"):
        one, other = getattr(ours, name), getattr(theirs, name)
        torch.testing.assert_close(one.double(), other, atol=2e-5, rtol=1e-5)
    torch.testing.assert_close(ours.weight.double(), theirs.weight, atol=weights, rtol=2e-5)
    left = theirs.transmittance
    torch.testing.assert_close(ours.transmittance.double(), left, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(ours.depth.double(), theirs.depth, atol=2e-5, rtol=1e-4)
    assert not ours.depth.requires_grad and not theirs.depth.requires_grad


def assert_same_gradient(ours: Tensor, theirs: Tensor) -> None:
    scale = theirs.abs().max()
    assert scale > 0.1
    torch.testing.assert_close(ours.double() / scale, theirs / scale, atol=2e-5, rtol=0)


def random_loss(samples: Samples, seed: int = 3) -> Tensor:
    """A random linear function of all that has a gradient."""
    rng = torch.Generator().manual_seed(seed)
    parts = [samples.weight, samples.transmittance]
    if samples.canonical.requires_grad:
        parts.append(samples.canonical)
    return sum((torch.randn(p.shape, generator=rng).to(p) * p).sum() for p in parts)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("zero_outside_box", [False, True])
def test_samples_and_gradients_are_those_of_the_definition(
    space: str, zero_outside_box: bool, rng: torch.Generator
) -> None:
    given = setting(space, 400, rng)
    moving = inputs(given, rng, zero_outside_box=zero_outside_box)
    rays = clear_rays(given.rays, given.range, moving)
    moving.density.requires_grad_()
    moving.displacement.requires_grad_()
    truth = exact(moving, learned=True)
    ours, theirs = march(rays, moving), definition.march(doubled(rays), truth)
    assert_same(ours, theirs)
    # Rays that miss, that end, and that see through.
    left = theirs.transmittance
    assert (left == 1).any() and (left < STOP).any() and ((left > 0.1) & (left < 0.9)).any()
    inside = moving.displacement_box.contains(theirs.points)
    assert inside.any() and not inside.all()
    assert torch.equal(ours.canonical[~inside], ours.points[~inside]) == zero_outside_box
    random_loss(ours).backward()
    random_loss(theirs).backward()
    assert_same_gradient(moving.density.grad, truth.density.grad)
    assert_same_gradient(moving.displacement.grad, truth.displacement.grad)


@pytest.mark.parametrize("space", SPACES)
def test_without_displacements(space: str, rng: torch.Generator) -> None:
    given = setting(space, 300, rng)
    resting = inputs(given, rng, moves=False)
    rays = clear_rays(given.rays, given.range, resting)
    resting.density.requires_grad_()
    truth = exact(resting, learned=True)
    ours, theirs = march(rays, resting), definition.march(doubled(rays), truth)
    assert_same(ours, theirs)
    assert torch.equal(ours.canonical, ours.points) and not ours.canonical.requires_grad
    random_loss(ours).backward()
    random_loss(theirs).backward()
    assert_same_gradient(resting.density.grad, truth.density.grad)


@pytest.mark.parametrize("output", ["canonical", "weight", "transmittance"])
def test_each_output_has_its_own_gradient(output: str, rng: torch.Generator) -> None:
    given = setting("world", 300, rng)
    moving = inputs(given, rng)
    rays = clear_rays(given.rays, given.range, moving)
    moving.density.requires_grad_()
    moving.displacement.requires_grad_()
    truth = exact(moving, learned=True)
    (getattr(march(rays, moving), output) ** 2).sum().backward()
    (getattr(definition.march(doubled(rays), truth), output) ** 2).sum().backward()
    assert_same_gradient(moving.displacement.grad, truth.displacement.grad)
    if output == "canonical":
        assert not moving.density.grad.any()
    else:
        assert_same_gradient(moving.density.grad, truth.density.grad)


@pytest.mark.parametrize("learned", ["density", "displacement"])
def test_only_what_needs_a_gradient_gets_one(learned: str, rng: torch.Generator) -> None:
    given = setting("world", 50, rng)
    moving = inputs(given, rng)
    assert not march(given.rays, moving).weight.requires_grad
    getattr(moving, learned).requires_grad_()
    samples = march(given.rays, moving)
    assert samples.weight.requires_grad
    assert samples.canonical.requires_grad == (learned == "displacement")
    random_loss(samples).backward()
    for name in ("density", "displacement"):
        assert (getattr(moving, name).grad is not None) == (name == learned)


@pytest.mark.parametrize("threshold", [0.0, 1e-7])
@pytest.mark.parametrize("moves", [False, True])
def test_tiny_opacities_keep_their_digits(
    threshold: float, moves: bool, rng: torch.Generator
) -> None:
    given = setting("world", 300, rng)
    # As at first in the search for geometry: a base voxel's opacity is about 10⁻⁶.
    faint = replace(
        inputs(given, rng, moves=moves),
        density=1.5 * torch.randn(6, 7, 5, 1, generator=rng),
        shift=math.log(1 / (1 - 1e-6) - 1),
        delta=0.5,
        threshold=threshold,
    )
    rays = clear_rays(given.rays, given.range, faint)
    faint.density.requires_grad_()
    truth = exact(faint, learned=True)
    ours, theirs = march(rays, faint), definition.march(doubled(rays), truth)
    assert_same(ours, theirs, weights=0.0)
    every = definition.march(doubled(rays), replace(truth, threshold=0.0))
    assert 1000 < len(theirs.ray) <= len(every.ray)
    assert (len(theirs.ray) == len(every.ray)) == (threshold == 0)
    assert every.weight.detach().min() > 1e-9 and every.weight.detach().max() < 1e-3
    ours.weight.sum().backward()
    theirs.weight.sum().backward()
    of_density = truth.density.grad
    assert of_density.abs().max() > 1e-6
    torch.testing.assert_close(faint.density.grad.double(), of_density, atol=1e-9, rtol=1e-4)


def test_opaque_matter_has_weight_one_and_finite_gradients(rng: torch.Generator) -> None:
    given = setting("world", 300, rng, share=1.0)
    solid = replace(inputs(given, rng), density=torch.full((6, 7, 5, 1), 300.0))
    rays = clear_rays(given.rays, given.range, solid)
    solid.density.requires_grad_()
    solid.displacement.requires_grad_()
    samples = march(rays, solid)
    # A ray meets the first sample in the box, and no other.
    assert torch.equal(samples.ray, samples.ray.unique()) and len(samples.ray) > 50
    assert torch.equal(samples.weight, torch.ones(len(samples.ray)))
    missed = torch.ones(len(rays), dtype=torch.bool)
    missed[samples.ray] = False
    assert torch.equal(samples.transmittance, missed.float())
    random_loss(samples).backward()
    assert solid.density.grad.isfinite().all() and solid.displacement.grad.isfinite().all()
    assert solid.displacement.grad.any()


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("moves", [False, True])
def test_no_ray_and_one_ray(space: str, moves: bool, rng: torch.Generator) -> None:
    given = setting(space, 300, rng)
    moving = inputs(given, rng, moves=moves)
    rays = clear_rays(given.rays, given.range, moving)
    seen = march(rays, moving)
    number = int(seen.ray.bincount().argmax())
    learned = [t.requires_grad_() for t in (moving.density, moving.displacement) if t is not None]
    one = march(rays[number : number + 1], moving)
    of_it = seen.ray == number
    assert of_it.sum() > 3 and not one.ray.any()
    for name in ("distance", "points", "canonical", "weight"):
        assert torch.equal(getattr(one, name), getattr(seen, name)[of_it])
    assert torch.equal(one.transmittance, seen.transmittance[number : number + 1])
    none = march(rays[:0], moving)
    assert len(none.ray) == len(none.weight) == len(none.transmittance) == 0
    assert none.canonical.shape == none.points.shape == (0, 3)
    random_loss(none).backward()
    assert all(not tensor.grad.any() for tensor in learned)


def test_rays_that_meet_nothing(rng: torch.Generator) -> None:
    given = setting("world", 200, rng)
    moving = inputs(given, rng)
    moving.density.requires_grad_()
    moving.displacement.requires_grad_()
    away = Rays(given.rays.origins + 20.0, given.rays.directions, given.rays.viewdirs)
    nothing = Occupancy(torch.zeros(9, 8, 7, dtype=torch.bool), given.range.box).distances
    empty = replace(given.range, distances=nothing)
    for rays, limits in ((away, given.range), (given.rays, empty)):
        samples = march(rays, replace(moving, range=limits))
        assert len(samples.ray) == 0
        assert torch.equal(samples.transmittance, torch.ones(200))
        (samples.canonical.sum() + samples.weight.sum() + samples.transmittance.sum()).backward()
        assert not moving.density.grad.any() and not moving.displacement.grad.any()


def test_the_last_plane_counts(rng: torch.Generator) -> None:
    # From the near plane to infinity a ray has as many samples as there are planes.
    rays = setting("ndc", 100, rng).rays
    box = Box((-9.0, -9.0, -1.0), (9.0, 9.0, 1.0))
    assert box.contains(rays.origins).sum() > 20
    for planes in (2, 16, 65, 129):
        limits = MarchRange(
            box, Occupancy.full((2, 2, 2), box).distances, 1 / (planes - 1), 0.0, 1.0
        )
        clear = MarchInputs(limits, torch.full((2, 2, 2, 1), -30.0), 0.0, 1.0, 0.0)
        ours, theirs = (
            m.march(rays, clear) for m in (definition, __import__("devrf").kernels.march)
        )
        assert torch.equal(ours.ray, theirs.ray)
        assert planes in ours.ray.bincount()


def wide_rays(space: ContractedSpace, count: int, rng: torch.Generator) -> ContractedRays:
    """World rays from in and around the inner box: any direction, along axes and diagonals."""
    half = torch.tensor(space.inner().size) / 2
    reach = torch.rand(count, 1, generator=rng) * 2
    origins = torch.tensor(space.inner().middle) + reach * half * torch.randn(
        count, 3, generator=rng
    ).clamp(-1.5, 1.5)
    directions = torch.randn(count, 3, generator=rng)
    third = count // 3
    directions[:third] = directions[:third] ** 5
    # The fastest go along a diagonal, but for a little, and past the centre.
    directions[third : 2 * third] = (
        directions[third : 2 * third].sign() + 0.05 * directions[third : 2 * third]
    ) * half
    directions = torch.nn.functional.normalize(directions, dim=1)
    return space.rays(Rays(origins, directions, directions))


@pytest.mark.parametrize("shell", [0.25, 1.0, 2.5])
@pytest.mark.parametrize("edges", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.5), (1.0, 0.4, 2.0)])
@pytest.mark.parametrize("cubic", [True, False])
def test_curved_rays_never_skip_what_is_occupied(
    edges: tuple[float, float, float], shell: float, cubic: bool, rng: torch.Generator
) -> None:
    space = ContractedSpace(tuple(-edge for edge in edges), edges, shell)
    # Cells as long as wide, or as many along every axis.
    shape = space.box.grid_shape(30**3) if cubic else (30, 30, 30)
    occupancy = Occupancy(torch.rand(*shape, generator=rng) < 1e-3, space.box)
    limits = MarchRange(space.box, occupancy.distances, 0.02, 0.05, math.inf)
    rays = clear_rays(wide_rays(space, 2500, rng), limits)
    nothing_hidden = MarchInputs(limits, torch.full((2, 2, 2, 1), -30.0), 0.0, 1.0, 0.0)
    ours, theirs = (
        march(rays, nothing_hidden),
        definition.march(doubled(rays), exact(nothing_hidden)),
    )
    assert len(theirs.ray) > 200
    assert torch.equal(ours.ray, theirs.ray)
    torch.testing.assert_close(ours.distance.double(), theirs.distance, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("shell", [0.5, 1.0])
@pytest.mark.parametrize("edges", [(1.0, 1.0, 1.0), (1.0, 0.4, 2.0)])
def test_the_fastest_curved_rays_skip_nothing(
    edges: tuple[float, float, float], shell: float
) -> None:
    space = ContractedSpace(tuple(-edge for edge in edges), edges, shell)
    half = torch.tensor(edges)
    # Along diagonals, past the centre: far away they move sideways almost five half edges while
    # they move one along the axis that they cross fastest.
    origins = torch.tensor([[-0.2, 2.1, 1.0], [-1.4, 0.0, 2.5]]) * half
    directions = torch.tensor([[0.98, 0.99, 1.0], [-1.0, 0.99, 0.98]]) * half
    directions = torch.nn.functional.normalize(directions, dim=1)
    rays = space.rays(Rays(origins, directions, directions))
    cell, around = 0.015 * half, torch.arange(-30, 31)
    away = torch.stack(torch.meshgrid(around, around, around, indexing="ij")).abs().amax(dim=0)
    distances = away.clamp(max=Occupancy.FARTHEST).to(torch.uint8)
    step, (entry, leave) = 0.005, rays.crossing(*space.box.corners(half), 0.05, math.inf)
    for k in range(2):
        ray = rays[k : k + 1]
        places = torch.arange(float(entry[k]), float(leave[k]), step)[-150:]
        points = ray.at(torch.zeros(len(places), dtype=torch.long), places)
        for number, point in enumerate(points):
            # One cell is occupied, that of a sample, in the middle of a grid. Outside it the ray
            # skips nothing, so that the grid's size decides where its strides begin.
            reach = 10 + number % 20
            box = Box.of(point - reach * cell, point + reach * cell)
            part = slice(30 - reach, 31 + reach)
            nearby = OccupancyDistances(distances[part, part, part].contiguous(), box)
            limits = MarchRange(space.box, nearby, step, 0.05, math.inf)
            clear = MarchInputs(limits, torch.full((2, 2, 2, 1), -30.0), 0.0, 1.0, 0.0)
            assert len(march(ray, clear).ray) > 0


@pytest.mark.parametrize("share", [1e-3, 1e-2])
def test_straight_rays_never_skip_what_is_occupied(share: float, rng: torch.Generator) -> None:
    given = setting("world", 3000, rng)
    occupancy = Occupancy(torch.rand(41, 30, 52, generator=rng) < share, WORLD_BOX)
    limits = replace(given.range, distances=occupancy.distances, step=0.013)
    rays = clear_rays(given.rays, limits)
    nothing_hidden = MarchInputs(limits, torch.full((2, 2, 2, 1), -30.0), 0.0, 1.0, 0.0)
    ours, theirs = (
        march(rays, nothing_hidden),
        definition.march(doubled(rays), exact(nothing_hidden)),
    )
    assert len(theirs.ray) > 50 and torch.equal(ours.ray, theirs.ray)
    torch.testing.assert_close(ours.distance.double(), theirs.distance, atol=1e-4, rtol=1e-5)


def test_a_gradient_that_the_densities_have_is_added_to(rng: torch.Generator) -> None:
    given = setting("world", 200, rng)
    moving = inputs(given, rng)
    density = moving.density.requires_grad_()
    march(given.rays, moving).weight.sum().backward()
    first, place = density.grad.clone(), density.grad
    march(given.rays, moving).transmittance.sum().backward()
    assert density.grad is place
    fresh = replace(moving, density=density.detach().clone().requires_grad_())
    march(given.rays, fresh).transmittance.sum().backward()
    assert first.any() and fresh.density.grad.any()
    torch.testing.assert_close(density.grad, first + fresh.density.grad, atol=1e-5, rtol=1e-5)


def test_rays_and_gradients_may_lie_in_memory_anyhow(rng: torch.Generator) -> None:
    given = setting("world", 200, rng)
    moving = inputs(given, rng)
    moving.displacement.requires_grad_()
    whole = march(given.rays, moving)
    scattered = Rays(
        given.rays.origins.t().contiguous().t(),
        given.rays.directions.repeat(1, 2)[:, :3],
        given.rays.viewdirs,
    )
    assert not scattered.origins.is_contiguous() and not scattered.directions.is_contiguous()
    again = march(scattered, moving)
    assert torch.equal(whole.weight, again.weight)
    (of_whole,) = torch.autograd.grad(
        (whole.canonical + whole.weight[:, None]).sum() + whole.transmittance.sum(),
        moving.displacement,
    )
    # Gradients of sums are one number in all places.
    (of_again,) = torch.autograd.grad(
        again.canonical.sum() + 3 * again.weight.sum() + again.transmittance.sum(),
        moving.displacement,
    )
    torch.testing.assert_close(of_whole, of_again)

"""The march along rays: where it samples, where it ends, and its gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.ops.march import STOP, MarchInputs, MarchRange, march, steps_through
from devrf.rendering.occupancy import Occupancy

BOX = Box((-1.0, -0.5, 0.0), (1.0, 1.5, 1.0))


def scattered_rays(count, rng):
    """Float64 rays from all around, some from inside, towards the box or past it."""
    origins = 2.5 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    targets = 1.3 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    d = torch.nn.functional.normalize(targets - origins, dim=1)
    return Rays(origins, d, d)


def through(occupancy, step, near, far, *, box=BOX):
    return MarchRange(box, occupancy.distances, step, near, far)


def fog(limits, tau=1e-9, threshold=0.0):
    """A scene in which every sample has optical depth ``tau``."""
    density = torch.full((2, 2, 2, 1), math.log(math.expm1(tau)), dtype=torch.float64)
    return MarchInputs(limits, density, shift=0.0, delta=1.0, threshold=threshold)


def slowly(rays, occupancy, step, near, far):
    """Ray and distance of every sample entry + k·step that is in an occupied cell."""
    entry, leave = BOX.crossing(rays)
    entry, leave = entry.clamp(min=near), leave.clamp(max=far)
    distance = entry[:, None] + step * torch.arange(500, dtype=entry.dtype)
    ray = torch.arange(len(rays))[:, None].expand_as(distance)
    # The exit itself counts, up to rounding.
    kept = distance <= leave[:, None] + 1e-3 * step
    ray, distance = ray[kept], distance[kept]
    kept = occupancy.at(rays.at(ray, distance))
    return ray[kept], distance[kept]


@pytest.mark.parametrize(("share", "step"), [(0.0, 0.11), (0.02, 0.02), (0.3, 0.5), (1.0, 0.11)])
def test_finds_exactly_the_samples_in_occupied_cells(share, step, rng):
    rays = scattered_rays(300, rng)
    occupancy = Occupancy(torch.rand(9, 12, 5, generator=rng) < share, BOX)
    samples = march(rays, fog(through(occupancy, step, near=0.3, far=6.0)))
    ray, distance = slowly(rays, occupancy, step, 0.3, 6.0)
    assert torch.equal(samples.ray, ray)
    torch.testing.assert_close(samples.distance, distance, atol=1e-6, rtol=0)
    torch.testing.assert_close(samples.points, rays.at(ray, distance), atol=1e-6, rtol=0)
    assert torch.equal(samples.canonical, samples.points)
    assert samples.transmittance.shape == (300,)


@pytest.mark.parametrize("high", [(1.0, 1.0, 1.0), (1.0, 0.4, 2.0)])
def test_curved_rays_find_them_too(high, rng):
    space = ContractedSpace(tuple(-edge for edge in high), high)
    inside = scattered_rays(300, rng)
    rays = space.rays(Rays(0.5 * inside.origins, inside.directions, inside.viewdirs))
    occupancy = Occupancy(torch.rand(24, 20, 28, generator=rng) < 0.02, space.box)
    limits = {"step": 0.05, "near": 0.1, "far": math.inf}
    entry, count = steps_through(rays, space.box, **limits)
    ray = torch.repeat_interleave(count)
    number = torch.arange(len(ray)) - (count.cumsum(0) - count)[ray]
    kept = occupancy.at(rays.at(ray, entry[ray] + 0.05 * number))
    samples = march(rays, fog(through(occupancy, **limits, box=space.box)))
    assert len(samples.ray) > 100 and torch.equal(samples.ray, ray[kept])
    torch.testing.assert_close(samples.distance, (entry[ray] + 0.05 * number)[kept])


def test_sample_places_by_hand(cube):
    d = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]], dtype=torch.float64), d, d)
    full = Occupancy.full((5, 5, 5), cube)
    samples = march(rays, fog(through(full, 0.5, near=0.0, far=9.0, box=cube)))
    # Entry at distance 2, exit at 4: both are samples.
    assert samples.distance.tolist() == [2.0, 2.5, 3.0, 3.5, 4.0]
    near = march(rays, fog(through(full, 0.5, near=2.25, far=3.0, box=cube)))
    assert near.distance.tolist() == [2.25, 2.75]


def test_weights_by_hand(cube):
    d = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]], dtype=torch.float64), d, d)
    limits = through(Occupancy.full((5, 5, 5), cube), 0.5, near=0.0, far=9.0, box=cube)
    # Each of five samples lets a half pass.
    samples = march(rays, fog(limits, math.log(2)))
    assert samples.weight.tolist() == pytest.approx([1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32])
    assert samples.transmittance.item() == pytest.approx(1 / 32)
    # What has too little weight shades all the same.
    samples = march(rays, fog(limits, math.log(2), threshold=0.2))
    assert samples.weight.tolist() == pytest.approx([1 / 2, 1 / 4])
    assert samples.transmittance.item() == pytest.approx(1 / 32)
    # What is too faint does not.
    samples = march(rays, fog(limits, math.log(2), threshold=0.51))
    assert len(samples.ray) == len(samples.weight) == 0 and samples.transmittance.item() == 1


def test_nothing_is_sampled_behind_what_nothing_is_seen_through(cube):
    d = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]], dtype=torch.float64), d, d)
    limits = through(Occupancy.full((5, 5, 5), cube), 0.01, near=0.0, far=9.0, box=cube)
    samples = march(rays, fog(limits, math.log(10)))
    # 10⁻⁴ is not less than STOP, up to rounding.
    assert STOP == 1e-4 and len(samples.ray) in (4, 5)
    samples = march(rays, fog(limits, math.log(9.9)))
    assert samples.weight.tolist() == pytest.approx([8.9 / 9.9**k for k in range(1, 6)])
    assert samples.transmittance.item() == pytest.approx(9.9**-5)


def test_no_rays_and_missing_rays_give_no_samples(cube):
    limits = through(Occupancy.full((3, 3, 3), cube), 0.1, near=0.0, far=9.0, box=cube)
    none = Rays(*[torch.zeros(0, 3, dtype=torch.float64)] * 3)
    assert len(march(none, fog(limits)).ray) == 0
    d = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    past = Rays(torch.tensor([[-3.0, 2.0, 0.0], [-3.0, 0.0, 0.0]], dtype=torch.float64), d, d)
    samples = march(past, fog(limits))
    assert len(samples.ray) == 0 and samples.transmittance.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("zero_outside_box", [False, True])
def test_gradients_of_densities_and_displacements(zero_outside_box, rng):
    rays = scattered_rays(24, rng)
    # Smaller than the field's box, so that some samples are outside.
    displacement_box = Box((-0.6, -0.3, 0.1), (0.7, 1.1, 0.8))
    limits = through(Occupancy.full((3, 4, 3), BOX), 0.4, near=0.3, far=6.0)

    def outputs(density, displacement):
        moving = MarchInputs(
            limits,
            density,
            0.3,
            0.8,
            0.05,
            displacement,
            displacement_box,
            zero_outside_box=zero_outside_box,
        )
        samples = march(rays, moving)
        return samples.canonical, samples.weight, samples.transmittance

    density = torch.randn(3, 4, 3, 1, generator=rng, dtype=torch.float64).requires_grad_()
    displacement = torch.randn(2, 3, 2, 3, generator=rng, dtype=torch.float64).mul_(0.1)
    displacement.requires_grad_()
    canonical, weight, _ = outputs(density, displacement)
    assert len(weight) > 10
    assert gradcheck(outputs, (density, displacement))


def test_what_is_outside_of_moving_space_may_stay(cube):
    d = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]], dtype=torch.float64), d, d)
    limits = through(Occupancy.full((5, 5, 5), cube), 0.5, near=0.0, far=9.0, box=cube)
    shift = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
    moving = replace(
        fog(limits),
        displacement=shift.expand(2, 2, 2, 3),
        displacement_box=Box((-0.5,) * 3, (0.5,) * 3),
    )
    moved = march(rays, moving)
    torch.testing.assert_close(moved.canonical - moved.points, shift.expand(5, 3))
    still = march(rays, replace(moving, zero_outside_box=True))
    # The faces belong to the box.
    moves = torch.tensor([[0.0], [1.0], [1.0], [1.0], [0.0]], dtype=torch.float64)
    torch.testing.assert_close(still.canonical - still.points, moves * shift)

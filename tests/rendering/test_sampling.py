"""Marching along rays, compared with testing every sample."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import hits, march, steps_through

BOX = Box((-1.0, -0.5, 0.0), (1.0, 1.5, 1.0))


def scattered_rays(count, rng):
    """Float64 rays from all around, some from inside, towards the box or past it."""
    origins = 2.5 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    targets = 1.3 * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    d = torch.nn.functional.normalize(targets - origins, dim=1)
    return Rays(origins, d, d)


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
    samples = march(rays, BOX, occupancy, step=step, near=0.3, far=6.0)
    ray, distance = slowly(rays, occupancy, step, 0.3, 6.0)
    assert torch.equal(samples.ray, ray)
    torch.testing.assert_close(samples.distance, distance, atol=1e-6, rtol=0)
    torch.testing.assert_close(samples.points, rays.at(ray, distance), atol=1e-6, rtol=0)
    assert samples.rays == len(rays)


@pytest.mark.parametrize("high", [(1.0, 1.0, 1.0), (1.0, 0.4, 2.0)])
def test_curved_rays_find_them_too(high, rng):
    space = ContractedSpace(tuple(-edge for edge in high), high)
    inside = scattered_rays(300, rng)
    rays = space.rays(Rays(0.5 * inside.origins, inside.directions, inside.viewdirs))
    occupancy = Occupancy(torch.rand(24, 20, 28, generator=rng) < 0.02, space.box)
    box, limits = space.box, {"step": 0.05, "near": 0.1, "far": float("inf")}
    entry, count = steps_through(rays, box, **limits)
    ray = torch.repeat_interleave(count)
    number = torch.arange(len(ray)) - (count.cumsum(0) - count)[ray]
    kept = occupancy.at(rays.at(ray, entry[ray] + 0.05 * number))
    samples = march(rays, box, occupancy, **limits)
    assert len(samples) > 100 and torch.equal(samples.ray, ray[kept])
    torch.testing.assert_close(samples.distance, (entry[ray] + 0.05 * number)[kept])
    assert hits(rays, box, occupancy, near=0.1, far=float("inf"))[ray[kept]].all()


def test_sample_places_by_hand(cube):
    d = torch.tensor([[1.0, 0.0, 0.0]])
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]]), d, d)
    samples = march(rays, cube, Occupancy.full((5, 5, 5), cube), step=0.5, near=0.0, far=9.0)
    # Entry at distance 2, exit at 4: both are samples.
    assert samples.distance.tolist() == [2.0, 2.5, 3.0, 3.5, 4.0]
    near = march(rays, cube, Occupancy.full((5, 5, 5), cube), step=0.5, near=2.25, far=3.0)
    assert near.distance.tolist() == [2.25, 2.75]


def test_a_ray_that_march_samples_is_never_left_out(rng):
    rays = scattered_rays(3000, rng)
    for share in (0.01, 0.1):
        occupancy = Occupancy(torch.rand(6, 7, 4, generator=rng) < share, BOX)
        ray, _ = slowly(rays, occupancy, 0.003, 0.3, 4.0)
        hit = hits(rays, BOX, occupancy, near=0.3, far=4.0, chunk=1000)
        assert hit[ray].all()
        assert not hit.all()


def test_no_rays_and_missing_rays_give_no_samples(cube):
    full = Occupancy.full((3, 3, 3), cube)
    none = Rays(*[torch.zeros(0, 3)] * 3)
    assert len(march(none, cube, full, step=0.1, near=0.0, far=9.0)) == 0
    assert hits(none, cube, full, near=0.0, far=9.0).shape == (0,)
    d = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    past = Rays(torch.tensor([[-3.0, 2.0, 0.0], [-3.0, 0.0, 0.0]]), d, d)
    assert len(march(past, cube, full, step=0.1, near=0.0, far=9.0)) == 0
    assert hits(past, cube, full, near=0.0, far=9.0).tolist() == [False, False]

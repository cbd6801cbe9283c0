"""The spaces of fields by hand: contracted space, and normalised device coordinates."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, space_config, space_from
from devrf.rendering.renderer import points_at_depth

# Inner half edges 1, 2, 4 about (1, 0, 0): not a cube, so that a swap of axes shows.
SPACE = ContractedSpace((0.0, -2.0, -4.0), (2.0, 2.0, 4.0), shell=1.0)
CUBE = ContractedSpace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), shell=0.5)


@pytest.mark.parametrize(
    ("world", "contracted"),
    [
        ((1.5, -2.0, 3.0), (1.5, -2.0, 3.0)),  # inside, on a face: as it is
        ((3.0, 0.0, 0.0), (2.5, 0.0, 0.0)),  # u = 2: 2 − 1/2 half edges of 1 from 1
        ((1.0, 8.0, 8.0), (1.0, 3.5, 3.5)),  # u = (0, 4, 2): 1.75 of (0, 2, 2)
        ((1.0, 0.0, -(2.0**19)), (1.0, 0.0, -8 + 2.0**-15)),  # far away: the outer face
    ],
)
def test_points_by_hand(world, contracted):
    torch.testing.assert_close(SPACE.from_world(torch.tensor([world])), torch.tensor([contracted]))
    torch.testing.assert_close(SPACE.to_world(torch.tensor([contracted])), torch.tensor([world]))


def test_a_thin_shell_by_hand():
    assert CUBE.box == Box((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
    assert CUBE.inner() == Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    contracted = CUBE.from_world(torch.tensor([[0.0, -5.0, 2.5]]))
    torch.testing.assert_close(contracted, torch.tensor([[0.0, -1.4, 0.7]]))


def test_there_and_back(rng):
    points = 20 * torch.randn(1000, 3, generator=rng, dtype=torch.float64)
    for space in (SPACE, CUBE):
        contracted = space.from_world(points)
        assert bool(space.box.contains(contracted).all())
        torch.testing.assert_close(space.to_world(contracted), points)
    corner = torch.tensor([[1.5, 1.5, -1.5]])  # infinity stays finite
    assert bool(CUBE.to_world(corner).isfinite().all())
    assert float(CUBE.to_world(corner).amax()) > 1e5


def _rays(rng: torch.Generator, count: int, scale: float) -> Rays:
    directions = torch.randn(count, 3, generator=rng)
    directions = torch.nn.functional.normalize(directions, dim=1)
    return Rays(scale * torch.randn(count, 3, generator=rng), directions, directions)


def test_samples_are_evenly_spaced_in_disparity_along_a_ray():
    x = torch.tensor([[1.0, 0.0, 0.0]])
    rays = CUBE.rays(Rays(0 * x, x, x))
    entry, leave = CUBE.box.crossing(rays, 0.25, math.inf)
    assert (float(entry), float(leave)) == (0.25, 1.5)
    distance = torch.tensor([0.5, 1.0, 1.1, 1.2, 1.3, 1.4])
    ray = torch.zeros(6, dtype=torch.int64)
    # 1/t falls by 0.2 from one to the next beyond the inner box.
    expected = torch.tensor([0.5, 1.0, 1 / 0.8, 1 / 0.6, 1 / 0.4, 1 / 0.2])
    torch.testing.assert_close(rays.world_distance(ray, distance), expected)
    torch.testing.assert_close(rays.at(ray, distance)[:, 0], distance)
    torch.testing.assert_close(rays.ends(), 1.5 * x)


@pytest.mark.parametrize("scale", [0.3, 6.0])
def test_a_step_is_never_much_longer_in_contracted_space(rng, scale):
    rays = CUBE.rays(_rays(rng, 300, scale))
    entry, leave = CUBE.box.crossing(rays, 0.0, math.inf)
    assert bool((leave > entry).all())
    step, count = 1e-3, 200
    for share in (0.0, 0.2, 0.5, 0.8, 0.99):
        here = entry + share * (leave - entry - step)
        ray = torch.arange(len(rays))
        moved = rays.at(ray, here + step) - rays.at(ray, here)
        speed = moved.abs().amax(dim=1) / step
        assert float(speed.max()) < 3.15
    every = torch.linspace(0, 1, count)[:, None] * (leave - entry) + entry
    points = rays.at(torch.arange(len(rays)).repeat(count), every.reshape(-1))
    assert bool(CUBE.box.contains(points).all())


# Slopes 2·8/16 = 1 and 2·9/12 = 1.5: not square, so that a swap shows.


NDC = NormalizedDevice(width=16, height=12, focal=(8.0, 9.0), near=1.0)


@pytest.mark.parametrize(
    ("world", "device"),
    [
        ((0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),  # the near plane
        ((0.0, 0.0, -2.0), (0.0, 0.0, 0.0)),  # twice as far: the middle
        ((1.0, 0.0, -1.0), (1.0, 0.0, -1.0)),  # right edge of the picture: (W/2)/f = 1
        ((0.0, 2 / 3, -1.0), (0.0, 1.0, -1.0)),  # upper edge: (H/2)/f = 2/3
        ((2.0, -1.0, -4.0), (0.5, -0.375, 0.5)),
        ((0.0, 0.0, -(2.0**20)), (0.0, 0.0, 1 - 2.0**-19)),  # infinity: the far face
    ],
)
def test_ndc_points_by_hand(world, device):
    torch.testing.assert_close(NDC.from_world(torch.tensor([world])), torch.tensor([device]))
    torch.testing.assert_close(NDC.to_world(torch.tensor([device])), torch.tensor([world]))


def test_points_of_a_world_ray_lie_on_its_ndc_ray(rng):
    origins = 0.3 * torch.randn(50, 3, generator=rng, dtype=torch.float64)
    d = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    d[:, 2] = -1 - d[:, 2].abs()
    d = torch.nn.functional.normalize(d, dim=1)
    rays = NDC.rays(Rays(origins, d, d))
    depth = 1.5 + 6 * torch.rand(50, generator=rng, dtype=torch.float64)
    points = origins + d * (-(depth + origins[:, 2]) / d[:, 2])[:, None]
    device = NDC.from_world(points)
    # With o on the near plane and o + d at infinity, the point at depth z is at 1 − n/z.
    share = 1 - NDC.near / depth
    torch.testing.assert_close(rays.at(torch.arange(50), share), device)


@pytest.mark.parametrize("direction", [(-0.6, 0.0, 0.8), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_rays_that_do_not_look_ahead_meet_nothing_in_ndc(direction):
    backwards = torch.tensor([direction])
    rays = NDC.rays(Rays(torch.zeros(1, 3), backwards, backwards))
    entry, leave = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)).crossing(rays, 0.0, 1.0)
    assert bool(entry > leave)


def test_world_distances_are_depths_of_the_same_points(rng):
    distance = 0.5 + 5 * torch.rand(50, generator=rng)
    ahead = torch.tensor([0.0, 0.0, -4.0])
    for space, rays in (
        (WORLD, _rays(rng, 50, 1.0)),
        (CUBE, _rays(rng, 50, 1.0)),
        (NDC, _rays(rng, 50, 0.1)),
    ):
        if space is NDC:
            away = torch.nn.functional.normalize(rays.directions + ahead, dim=1)
            rays = Rays(rays.origins, away, away)
        depth = space.depths(rays, distance)
        expected = rays.at(torch.arange(50), distance)
        torch.testing.assert_close(
            points_at_depth(space, rays, depth), expected, atol=1e-3, rtol=1e-3
        )


def test_infinity_in_ndc_is_far_away_and_its_pixel_stays():
    # Half to the right in the picture: at any depth x / −z is 0.5, as the slope is 1.
    points = torch.tensor([[0.5, 0.0, 1.0]], requires_grad=True)
    world = NDC.to_world(points)
    assert world.isfinite().all() and bool((world[:, 2] < -9e5).all())
    torch.testing.assert_close(-world[:, 0] / world[:, 2], torch.tensor([0.5]))
    (world[:, 0] / world[:, 2]).sum().backward()
    assert points.grad is not None and points.grad.isfinite().all()


@pytest.mark.parametrize(
    "space", [WORLD, CUBE, NormalizedDevice(16, 12, (8.0, 9.0), 0.5)], ids=["world", "cube", "ndc"]
)
def test_spaces_come_back_from_plain_data(space):
    assert space_from(space_config(space)) == space

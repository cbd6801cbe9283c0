"""Pixels worth learning from."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.pixel_pools import HIT_CELLS, block_size, rays_hit_occupied, rays_that_hit
from devrf.ops.march import MarchRange, samples_in_box
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.sampling import RenderSettings

BOX = Box((-1.0, -0.5, 0.0), (1.0, 1.5, 1.0))
CURVED = ContractedSpace((-1.0, -0.9, -1.1), (1.0, 0.9, 1.1))


def scattered_rays(count: int, spread: float, rng: torch.Generator, kind: torch.dtype) -> Rays:
    """Rays from all around, some from inside, towards the box or past it."""
    origins = spread * torch.randn(count, 3, generator=rng, dtype=kind)
    targets = 1.3 * torch.randn(count, 3, generator=rng, dtype=kind)
    directions = torch.nn.functional.normalize(targets - origins, dim=1)
    return Rays(origins, directions, directions)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_a_ray_hits_what_is_two_cells_away_and_nothing_farther(
    cube: Box, kind: torch.dtype
) -> None:
    mask = torch.zeros(21, 21, 21, dtype=torch.bool)
    mask[10, 10, 10] = True
    distances = Occupancy(mask, cube).distances
    heights = torch.tensor([0.0, 0.1, 0.2, 0.24, 0.26, 0.3], dtype=kind)
    origins = torch.stack([torch.full_like(heights, -3.0), heights, 0 * heights], dim=1)
    along_x = torch.tensor([[1.0, 0.0, 0.0]], dtype=kind).expand(6, 3)
    rays = Rays(origins, along_x, along_x)
    # Cells are 0.1 wide, and points belong to the nearest.
    assert HIT_CELLS == 2
    limits = MarchRange(cube, distances, step=0.1, near=0.0, far=9.0)
    assert rays_that_hit(rays, limits).tolist() == [True] * 4 + [False] * 2
    before = MarchRange(cube, distances, step=0.1, near=0.0, far=2.74)
    assert not rays_that_hit(rays, before).any()
    assert rays_that_hit(rays[:0], limits).shape == (0,)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("share", [0.001, 0.002])
def test_a_ray_with_a_sample_in_an_occupied_cell_is_never_left_out(
    curved: bool, share: float, kind: torch.dtype, rng: torch.Generator
) -> None:
    box = CURVED.box if curved else BOX
    rays = scattered_rays(3000, 0.5 if curved else 2.5, rng, kind)
    rays = CURVED.rays(rays) if curved else rays
    occupancy = Occupancy(torch.rand(24, 20, 28, generator=rng) < share, box)
    far = math.inf if curved else 6.0
    limits = MarchRange(box, occupancy.distances, step=0.02, near=0.1, far=far)
    ray, _, points = samples_in_box(rays, limits)
    seen = ray[occupancy.at(points)].unique()
    coarse = MarchRange(box, occupancy.distances, occupancy.cell / rays.pace, near=0.1, far=far)
    hits = rays_that_hit(rays, coarse)
    assert len(seen) > 25 and hits[seen].all() and not hits.all()


@pytest.mark.parametrize(("by", "block"), [(1, 2), (5, 4), (20, 8)])
def test_no_pixel_that_meets_matter_is_left_out(cube: Box, by: int, block: int) -> None:
    width = 37 * by
    height = 25 * by + by // 2
    mask = torch.zeros(20, 20, 20, dtype=torch.bool)
    mask[3, 14, 9] = mask[12:14, 5, 5:8] = True
    occupancy = Occupancy(dilate(mask, 1), cube)
    build = Architecture()
    model = DeVRFModel(
        build,
        build.search_field(cube, 20**3),
        occupancy,
        RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.1, far=9.0),
    )
    cameras = Cameras.looking_at(
        torch.tensor([[2.5, 1.0, 1.0]]),
        torch.zeros(1, 3),
        focal=30.0 * by,
        width=width,
        height=height,
    )
    assert block_size(cameras, model, occupancy) == block
    together = rays_hit_occupied(cameras, torch.tensor([0, 0, 0]), model, occupancy)
    found = together[0]
    assert torch.equal(together, found.expand(3, -1))
    limits = MarchRange(cube, occupancy.distances, step=0.03, near=0.1, far=9.0)
    ray, _, points = samples_in_box(cameras.image_rays(0), limits)
    seen = torch.zeros(width * height, dtype=torch.bool)
    seen[ray[occupancy.at(points)]] = True
    assert found.shape == seen.shape
    assert 40 * by**2 < seen.sum() and found[seen].all()
    # A rim of a few pixels around them, no more.
    assert found.sum() < 6 * seen.sum() and not found.all()

"""Pixels worth learning from."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.pixel_pools import block_size, rays_hit_occupied
from devrf.ops.march import Path, samples_in_box
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.sampling import RenderSettings


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
    path = Path(cube, occupancy.surroundings, step=0.03, near=0.1, far=9.0)
    ray, _, points = samples_in_box(cameras.image_rays(0), path)
    seen = torch.zeros(width * height, dtype=torch.bool)
    seen[ray[occupancy.at(points)]] = True
    assert found.shape == seen.shape
    assert 40 * by**2 < seen.sum() and found[seen].all()
    # A rim of a few pixels around them, no more.
    assert found.sum() < 6 * seen.sum() and not found.all()

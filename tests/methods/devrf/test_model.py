"""A whole scene model: which time is seen, and where matter is then."""

from __future__ import annotations

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel, deformed_occupancy
from devrf.methods.devrf.settings import RenderSettings
from devrf.rendering.occupancy import Occupancy, dilate

SIDE = 11
SETTINGS = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.0, far=9.0)


@pytest.fixture
def model(cube: Box) -> DeVRFModel:
    """A red ball-like block in the middle that moves by +0.4 along x until t = 1."""
    mask = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    mask[5:7, 4:7, 4:7] = True
    canonical = Architecture().search_field(cube, SIDE**3)
    with torch.no_grad():
        canonical.density.values[mask] = 40.0
        canonical.color.values.copy_(torch.tensor([9.0, -9.0, -9.0]).expand(11, 11, 11, 3))
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=27)
    for frame, way in ((1, 0.2), (2, 0.4)):
        deformation.to_canonical[frame, ..., 0] = -way
        deformation.to_time[frame, ..., 0] = way
    return DeVRFModel(canonical, Occupancy(dilate(mask, 1), cube), SETTINGS, deformation)


def looking_down(count: int) -> Rays:
    """``count`` rays along −z at x from −0.95 to 0.95."""
    x = torch.linspace(-0.95, 0.95, count)
    origins = torch.stack([x, 0.02 + 0 * x, 3 + 0 * x], dim=1)
    d = torch.tensor([[0.0, 0.0, -1.0]]).expand(count, 3)
    return Rays(origins, d, d)


def middle(model: DeVRFModel, time: float) -> float:
    """Where along x the block is seen at ``time``."""
    rays = looking_down(191)
    opacity = model.picture(rays, time, torch.zeros(3)).opacity
    assert 20 < float(opacity.sum()) < 60
    return float((rays.origins[:, 0] * opacity).sum() / opacity.sum())


@pytest.mark.parametrize(("time", "way"), [(0.25, 0.1), (0.5, 0.2), (0.8, 0.32), (1.0, 0.4)])
def test_the_block_is_seen_where_it_has_moved(model: DeVRFModel, time: float, way: float) -> None:
    # 0.8 lies between frames: seen times in between move evenly.
    assert middle(model, time) - middle(model, 0.0) == pytest.approx(way, abs=0.02)


def test_at_rest_nothing_is_warped(model: DeVRFModel) -> None:
    assert model.warp(0.0) is None and model.occupancy_at(0.0) is model.occupancy
    moving, model.deformation = model.picture(looking_down(31), 0.0, torch.ones(3)), None
    still = model.picture(looking_down(31), 0.7, torch.ones(3))
    assert torch.equal(moving.color, still.color) and torch.equal(moving.depth, still.depth)


def test_occupancy_moves_with_the_matter(model: DeVRFModel) -> None:
    moved = model.occupancy_at(1.0).mask
    # 0.4 is two cells of 0.2; grown by one cell, for what lies between grid points.
    assert torch.equal(moved, dilate(torch.roll(model.occupancy.mask, 2, dims=0), 1))


def test_deformed_occupancy_by_hand(model: DeVRFModel) -> None:
    shift = torch.tensor([0.0, 0.4, 0.0])
    found = deformed_occupancy(model, lambda points: points + shift)
    assert torch.equal(found.mask, dilate(torch.roll(model.occupancy.mask, -2, dims=1), 1))
    assert found.box == model.canonical.box


def test_chunks_do_not_show(model: DeVRFModel) -> None:
    whole = model.picture(looking_down(50), 0.5, torch.ones(3))
    parts = model.picture(looking_down(50), 0.5, torch.ones(3), chunk=7)
    torch.testing.assert_close(parts.color, whole.color)
    torch.testing.assert_close(parts.depth, whole.depth)
    torch.testing.assert_close(parts.opacity, whole.opacity)


def test_depth_is_the_distance_of_the_face_and_zero_beside_it(model: DeVRFModel) -> None:
    rays = Rays(
        torch.tensor([[0.1, 0.0, 3.0], [-0.9, 0.0, 3.0]]),
        *[torch.tensor([[0.0, 0.0, -1.0]] * 2)] * 2,
    )
    picture = model.picture(rays, 0.0, torch.ones(3))
    # The block ends between the grid points 0.2 and 0.4 of z.
    assert 2.6 <= picture.depth[0].item() <= 2.8
    assert picture.depth[1].item() == 0
    torch.testing.assert_close(picture.color[1], torch.ones(3))
    assert picture.color[0, 0] > 0.99 and picture.color[0, 1] < 0.01


def test_the_rest_state_is_the_same_at_every_time(model: DeVRFModel) -> None:
    rest = model.at_rest()
    assert middle(rest, 1.0) == middle(model, 0.0)
    # It shares the fields: what is learned later shows in both.
    assert rest.canonical is model.canonical and model.deformation is not None

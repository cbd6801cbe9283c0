"""Pinhole cameras: pixels to rays and back, on images that are not square; lens distortion."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from devrf.geometry.cameras import Cameras, Distortion

IDENTITY = torch.eye(3, 4)[None]


def plain() -> Cameras:
    """A camera at the origin that looks along −z, with unequal focal lengths."""
    return Cameras(IDENTITY, torch.tensor([[10.0, 5.0]]), torch.tensor([[4.0, 3.0]]), 8, 6)


@pytest.fixture
def scattered(rng: torch.Generator) -> Cameras:
    """Five cameras anywhere, each with its own lens; 30×20 pixels."""
    looking = Cameras.looking_at(
        torch.randn(5, 3, generator=rng) * 4,
        torch.randn(5, 3, generator=rng),
        focal=1.0,
        width=30,
        height=20,
    )
    focal = 20 + 10 * torch.rand(5, 2, generator=rng)
    center = torch.tensor([15.0, 10.0]) + torch.randn(5, 2, generator=rng)
    return Cameras(looking.camera_to_world, focal, center, 30, 20)


def test_a_ray_by_hand():
    rays = plain().rays(torch.tensor([0]), torch.tensor([[14.0, 8.0]]))
    # ((14 − 4)/10, −(8 − 3)/5, −1) = (1, −1, −1): right, down, ahead.
    torch.testing.assert_close(rays.directions, torch.tensor([[1.0, -1.0, -1.0]]) / 3**0.5)
    assert torch.equal(rays.viewdirs, rays.directions)
    assert torch.equal(rays.origins, torch.zeros(1, 3))


def test_a_moved_camera_sees_a_pixel_by_hand():
    # At (0, 0, 5) turned a quarter about y: it looks along −x, its right is −z.
    pose = torch.tensor([[[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 5.0]]])
    camera = Cameras(pose, torch.tensor([[10.0, 5.0]]), torch.tensor([[4.0, 3.0]]), 8, 6)
    assert torch.equal(camera.positions, torch.tensor([[0.0, 0.0, 5.0]]))
    assert torch.equal(camera.forwards, torch.tensor([[-1.0, 0.0, 0.0]]))
    pixel, depth = camera.project(torch.tensor([0]), torch.tensor([[-2.0, 1.0, 4.0]]))
    # 2 ahead, 1 right, 1 up.
    torch.testing.assert_close(pixel, torch.tensor([[9.0, 0.5]]))
    assert depth.item() == 2.0


def test_projection_undoes_rays(scattered, rng):
    camera = torch.randint(5, (200,), generator=rng)
    pixels = torch.rand(200, 2, generator=rng) * torch.tensor([30.0, 20.0])
    rays = scattered.rays(camera, pixels)
    distance = 0.5 + 9 * torch.rand(200, generator=rng)
    again, depth = scattered.project(camera, rays.at(torch.arange(200), distance))
    torch.testing.assert_close(again, pixels, atol=2e-4, rtol=0)
    along = distance * (rays.directions * scattered.forwards[camera]).sum(dim=1)
    torch.testing.assert_close(depth, along, atol=1e-5, rtol=1e-5)


def test_image_rays_go_through_the_pixel_grid_and_project_into_undoes_them(scattered):
    # Row by row, x first.
    assert scattered.pixel_grid()[[0, 1, 30]].tolist() == [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]
    rays, camera = scattered.image_rays(3), torch.full((len(scattered.pixel_grid()),), 3)
    same = scattered.rays(camera, scattered.pixel_grid())
    torch.testing.assert_close(rays.directions, same.directions)
    assert torch.equal(rays.origins, same.origins)
    pixel, depth = scattered.project_into(3, rays.origins + 2 * rays.directions)
    torch.testing.assert_close(pixel, scattered.pixel_grid(), atol=1e-4, rtol=0)
    torch.testing.assert_close(depth, 2 * rays.directions @ scattered.forwards[3])


def test_resizing_scales_each_axis_by_its_own_factor(scattered, rng):
    small = scattered.resized(10, 4)
    assert (small.width, small.height) == (10, 4)
    camera = torch.randint(5, (40,), generator=rng)
    pixels = torch.rand(40, 2, generator=rng) * torch.tensor([30.0, 20.0])
    same = small.rays(camera, pixels / torch.tensor([3.0, 5.0]))
    torch.testing.assert_close(same.directions, scattered.rays(camera, pixels).directions)


def test_rows_of_a_raster_have_its_rays(scattered):
    band = scattered.rows(2, 5)
    width = scattered.width
    assert (band.width, band.height) == (width, 3)
    ours, theirs = band.image_rays(1), scattered.image_rays(1)[2 * width : 5 * width]
    torch.testing.assert_close(ours.directions, theirs.directions)
    assert torch.equal(ours.origins, theirs.origins)


def test_looking_at_puts_the_target_in_the_middle_and_up_above(rng):
    positions, targets = torch.randn(6, 3, generator=rng) * 3, torch.randn(6, 3, generator=rng)
    cameras = Cameras.looking_at(positions, targets, focal=20.0, width=12, height=8)
    every = torch.arange(6)
    pixel, depth = cameras.project(every, targets)
    torch.testing.assert_close(pixel, torch.tensor([[6.0, 4.0]]).expand(6, 2), atol=1e-4, rtol=0)
    torch.testing.assert_close(depth, (targets - positions).norm(dim=1))
    above, _ = cameras.project(every, targets + torch.tensor([0.0, 0.0, 0.05]))
    torch.testing.assert_close(above[:, 0], torch.full((6,), 6.0), atol=1e-3, rtol=0)
    assert (above[:, 1] < 4).all()


def test_looking_at_gives_right_handed_rigid_poses_even_straight_down():
    positions = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [2.0, 1.0, 1.0]])
    cameras = Cameras.looking_at(positions, torch.zeros(3, 3), focal=1.0, width=4, height=4)
    turn = cameras.camera_to_world[:, :, :3]
    eye = torch.eye(3).expand(3, 3, 3)
    torch.testing.assert_close(turn @ turn.transpose(1, 2), eye, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(3))


@pytest.mark.parametrize(("height", "width"), [(40, 60), (5, 8)])
def test_another_height_keeps_the_proportions(scattered, height, width):
    # The cameras have 30 x 20 pixels; a width of 7.5 is rounded to even.
    sized = scattered.of_height(height)
    assert (sized.width, sized.height) == (width, height)
    assert torch.equal(sized.focal[:, 1], scattered.focal[:, 1] * (height / 20))


BARREL = Distortion((-0.28, 0.07, 0.05, 0.0), (-0.001, 0.002))


def test_opencv_puts_points_in_the_same_places():
    axis = torch.linspace(-0.7, 0.7, 15, dtype=torch.float64)
    points = torch.cartesian_prod(axis, 0.75 * axis)
    (k1, k2, k3, _), tangential = BARREL.radial, BARREL.tangential
    ahead = torch.cat([points, torch.ones(len(points), 1)], dim=1).numpy()
    origin = np.zeros(3)
    theirs, _ = cv2.projectPoints(
        ahead, origin, origin, np.eye(3), np.array([k1, k2, *tangential, k3])
    )
    torch.testing.assert_close(BARREL.distort(points), torch.from_numpy(theirs[:, 0]))


def test_points_beyond_the_fold_are_not_upright():
    # r·(1 − r²/4) has its greatest value 0.7698 at r = 1.1547.
    lens = Distortion((-0.25, 0.0, 0.0, 0.0))
    fold = 2 / math.sqrt(3)
    x = torch.tensor([0.5, fold - 0.01, fold + 0.01, 3.0])
    points = torch.stack([x, torch.zeros(4)], dim=-1)
    assert lens.upright(points).tolist() == [True, True, False, False]


def test_images_of_several_sizes_are_scaled_with_their_raster():
    pose = torch.eye(3, 4)[None].repeat(3, 1, 1)
    focal, center = torch.full((3, 2), 110.0), torch.tensor([[48.0, 36], [36, 48], [36, 48]])
    sizes = torch.tensor([[96, 72], [72, 96], [72, 96]])
    cameras = Cameras(pose, focal, center, 96, 96, sizes)
    large = cameras.of_height(400)
    assert large.sizes.tolist() == [[400, 300], [300, 400], [300, 400]]
    assert (large.single(0).width, large.single(0).height) == (400, 300)
    assert cameras.extents.tolist() == sizes.tolist() and cameras[[1]].size_of(0) == (72, 96)
    one = cameras.of_commonest_size()
    assert (one.width, one.height, one.sizes) == (72, 96, None)
    assert one.center.tolist() == [[36, 48]] * 3
    same = Cameras(pose, focal, center, 96, 96)
    assert same.joined(cameras).sizes.tolist() == [[96, 96]] * 3 + sizes.tolist()
    with pytest.raises(ValueError, match="not of the raster"):
        Cameras(pose, focal, center, 96, 90, sizes).check()

"""The visual hull of mattes."""

from __future__ import annotations

import torch

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Views
from devrf.scenes.silhouettes import visual_hull

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
CENTER = torch.tensor([0.2, -0.1, 0.15])
RADIUS = 0.4


def ball_views(width: int = 72, height: int = 56) -> Views:
    """Exact mattes of a ball from twelve directions, non-square."""
    angle = torch.arange(12) * (2 * torch.pi / 12)
    height_of = 1.5 * torch.sin(3 * angle)
    positions = torch.stack([4 * angle.cos(), 4 * angle.sin(), height_of], dim=1)
    cameras = Cameras.looking_at(
        positions, torch.zeros(12, 3), focal=70.0, width=width, height=height
    )
    pixels = torch.zeros(12, height, width, 4, dtype=torch.uint8)
    for k in range(12):
        rays = cameras.image_rays(k)
        along = ((CENTER - rays.origins) * rays.directions).sum(dim=1)
        miss = (rays.at(torch.arange(len(rays)), along) - CENTER).norm(dim=1)
        pixels[k, :, :, 3] = 255 * (miss < RADIUS).view(height, width)
    count = torch.arange(12)
    return Views(pixels, cameras, torch.zeros(12), count, tuple("abcdefghijkl"))


def test_hull_holds_the_ball_and_little_more():
    shape = (33, 33, 33)
    hull = visual_hull(ball_views(), BOX, shape)
    distance = (BOX.grid_points(shape, torch.zeros(1)) - CENTER).norm(dim=-1)
    assert hull[distance < RADIUS].all()
    # A pixel is 0.06 wide here, a cell 0.06: no more than a few of both may be added.
    assert not hull[distance > RADIUS + 0.3].any()


def test_points_that_no_view_has_in_the_picture_stay():
    views = ball_views()
    away = Cameras.looking_at(
        views.cameras.positions,
        2 * views.cameras.positions,
        focal=70.0,
        width=views.width,
        height=views.height,
    )
    blind = Views(views.pixels, away, views.times, views.view, views.names)
    assert visual_hull(blind, BOX, (5, 5, 5)).all()

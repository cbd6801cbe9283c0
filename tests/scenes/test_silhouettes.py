"""The motion box: what it must hold, and how much larger it may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from devrf.geometry.box import Box
from devrf.scenes.scene import Views
from devrf.scenes.silhouettes import SEARCH, motion_box, visual_hull

BallViews = Callable[..., Views]
RADIUS = 0.35
# The ball goes along x and up, and leaves the box from −1 to 1 on the way.
PLACES = torch.stack(
    [torch.linspace(-0.5, 0.9, 6), torch.zeros(6), torch.linspace(0, 0.4, 6)], dim=-1
)


def test_box_holds_the_moving_ball_and_little_more(ball_views, cube):
    box = motion_box(ball_views(PLACES, RADIUS), cube.scaled(SEARCH))
    assert box is not None
    low, high = PLACES.amin(dim=0) - RADIUS, PLACES.amax(dim=0) + RADIUS
    assert bool(box.contains(torch.stack([low, high])).all())
    # A hull of four views that all look down a little: loose below, close elsewhere.
    slack_low = low - torch.tensor(box.low)
    slack_high = torch.tensor(box.high) - high
    assert float(slack_low.max()) < 0.3 and float(slack_high.max()) < 0.25


def test_a_ball_far_smaller_than_a_grid_cell_is_not_lost(ball_views, cube):
    place = torch.tensor([[0.31, 0.17, 0.23], [0.52, 0.17, 0.23]])
    box = motion_box(ball_views(place, 0.05), cube.scaled(SEARCH), resolution=12)
    assert box is not None and bool(box.contains(place).all())


def test_a_ball_cut_off_by_one_image_is_kept_whole(ball_views, cube):
    # Two of the cameras see as far as y = 1.93 only, the two others look along y.
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.9, 0.0]])
    views = ball_views(places, RADIUS)
    alpha = views.pixels[..., 3]
    cut = alpha[:, :, [0, -1]].flatten(1).amax(dim=1) > 0
    assert bool(cut.any()) and not bool(cut.all())
    box = motion_box(views, cube.scaled(1.6 * SEARCH))
    assert box is not None and box.high[1] >= 1.9 + RADIUS


def test_what_does_not_count_rules_nothing_out(ball_views, cube):
    views = ball_views(PLACES, RADIUS)
    box = motion_box(views, cube.scaled(SEARCH))
    valid_mask = torch.ones(views.pixels.shape[:3], dtype=torch.bool)
    assert motion_box(replace(views, valid_mask=valid_mask), cube.scaled(SEARCH)) == box
    # Two of the four views see nothing that counts: the hull is that of the others, and larger.
    valid_mask[views.view < 2] = False
    looser = motion_box(replace(views, valid_mask=valid_mask), cube.scaled(SEARCH))
    assert box is not None and looser is not None
    assert all(a <= b for a, b in zip(looser.low, box.low, strict=True))
    assert all(a >= b for a, b in zip(looser.high, box.high, strict=True))
    assert looser != box
    valid_mask[:] = False
    assert motion_box(replace(views, valid_mask=valid_mask), cube.scaled(SEARCH)) is None


def test_no_box_without_alpha_masks_or_without_two_cameras_at_every_time(ball_views, cube):
    assert motion_box(ball_views(PLACES, RADIUS, channels=3), cube) is None
    assert motion_box(ball_views(PLACES, RADIUS, count=1), cube) is None
    whole = ball_views(PLACES, RADIUS)
    missing = whole[torch.arange(len(whole) - 3)]  # the last time keeps one view of four
    assert motion_box(missing, cube) is None


CENTER = torch.tensor([0.2, -0.1, 0.15])
BALL = 0.4


def test_hull_holds_the_ball_and_little_more(ball_views, cube):
    shape = (33, 33, 33)
    hull = visual_hull(ball_views(CENTER[None], BALL, count=12), cube, shape)
    distance = (cube.grid_points(shape, torch.zeros(1)) - CENTER).norm(dim=-1)
    assert hull[distance < BALL].all()
    # A cell is 0.06 wide; the cameras, all a little above, leave most below the ball.
    assert not hull[distance > BALL + 0.3].any()


@pytest.mark.parametrize("cut", [False, True])
def test_beyond_an_image_that_shows_all_of_it_there_may_be_nothing(ball_views, cut):
    views = ball_views(CENTER[None], BALL, count=4)
    if cut:
        views.pixels[:, :, 0] = 255  # the silhouettes reach an edge of the images
    wide = Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
    perhaps = visual_hull(views, wide, (19, 19, 19))
    within = visual_hull(views, wide, (19, 19, 19), whole_in_view=True)
    assert perhaps[0, 0, 0]  # no camera sees that corner
    assert bool(within[0, 0, 0]) is cut
    assert within[9, 9, 9] and not (within & ~perhaps).any()

"""Bounds from cameras: numbers by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.space import WORLD, Space
from devrf.scenes.bounds import (
    FALLBACK_BOUND_SCALE,
    axes_meet,
    box_from_cameras,
    depth_range,
    inward_bounds,
)
from devrf.scenes.scene import Bounds, Capture, GivenBounds, Scene, Views
from devrf.scenes.space import NEAR_SHARE, SHELL, dynamic_only, inward_space


def test_axes_meet_where_the_cameras_look(ring_cameras):
    cameras = ring_cameras(5, width=40, height=30, angle=0.7)
    offset = torch.tensor([1.0, -2.0, 0.5])
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] += offset
    torch.testing.assert_close(axes_meet(replace(cameras, camera_to_world=pose)), offset)


def test_box_of_the_usual_synthetic_cameras(ring_cameras):
    box = box_from_cameras(ring_cameras(9, width=80, height=80, angle=0.6911112))
    half = 4 * math.sin(0.6911112 / 2)
    assert half == pytest.approx(1.355, abs=1e-3)
    assert box.low == pytest.approx((-half,) * 3, abs=1e-5)
    assert box.high == pytest.approx((half,) * 3, abs=1e-5)


def test_the_box_of_crops_beside_their_axes_is_what_they_show(ring_cameras):
    """Cameras that look 40 degrees aside, and crops of what the middle is in."""
    ahead = ring_cameras(9, width=80, height=80, angle=1.2)
    turn = math.radians(40)
    rotation = torch.eye(3)
    rotation[0, 0] = rotation[2, 2] = math.cos(turn)
    rotation[0, 2], rotation[2, 0] = -math.sin(turn), math.sin(turn)
    poses = ahead.camera_to_world.clone()
    poses[:, :, :3] = poses[:, :, :3] @ rotation
    focal = float(ahead.focal[0, 0])
    center = torch.tensor([[40 + focal * math.tan(turn), 40.0]] * 9)
    box = box_from_cameras(replace(ahead, camera_to_world=poses, center=center))
    # The left edge is nearest to the middle, 40 px from it and that much further from the axis.
    half = 4 * math.sin(math.atan(math.tan(turn) + 40 / focal) - turn)
    assert box.high == pytest.approx((half,) * 3, abs=1e-4)
    assert box.low == pytest.approx((-half,) * 3, abs=1e-4)


def test_depth_range_holds_the_sphere_around_the_box(ring_cameras, cube):
    near, far = depth_range(ring_cameras(4, width=8, height=8, angle=0.7), cube)
    assert near == pytest.approx(4 - math.sqrt(3), abs=1e-5)
    assert far == pytest.approx(4 + math.sqrt(3), abs=1e-5)


def _transposed(poses: torch.Tensor) -> torch.Tensor:
    return torch.cat([poses[:, :, :3].mT, poses[:, :, 3:]], dim=2)


def _to_camera(poses: torch.Tensor) -> torch.Tensor:
    rotation = poses[:, :, :3].mT
    return torch.cat([rotation, -rotation @ poses[:, :, 3:]], dim=2)


def _opencv(poses: torch.Tensor) -> torch.Tensor:
    return poses * torch.tensor([1.0, -1, -1, 1])


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (_opencv, "in OpenCV's axes (y down, z ahead): negate the second and third column"),
        (_to_camera, "from world to camera: invert each matrix; else set data.box"),
        (
            lambda poses: _to_camera(_opencv(poses)),
            "from world to camera: invert each matrix, then",
        ),
        (_transposed, "transposed: transpose each rotation"),
    ],
)
def test_poses_of_another_convention_are_named(ring_cameras, written, said):
    cameras = ring_cameras(9, width=40, height=30, angle=0.7)
    read = replace(cameras, camera_to_world=written(cameras.camera_to_world))
    with pytest.raises(DevrfError) as caught:
        axes_meet(read)
    assert f"poses look as if they were {said}" in str(caught.value)


def test_cameras_that_wander_are_of_no_other_convention(ring_cameras):
    """Handheld, they look past the point by 25 degrees."""
    cameras = ring_cameras(12, width=40, height=30, angle=0.7)
    angle = torch.tensor(25.0).deg2rad() * torch.tensor([1.0, -1.0]).repeat(6)
    aside = torch.eye(3).repeat(12, 1, 1)
    aside[:, 0, 0] = aside[:, 2, 2] = angle.cos()
    aside[:, 0, 2] = angle.sin()
    aside[:, 2, 0] = -angle.sin()
    poses = cameras.camera_to_world.clone()
    poses[:, :, :3] = poses[:, :, :3] @ aside
    axes_meet(replace(cameras, camera_to_world=poses))


def test_parallel_axes_ask_for_a_box():
    where = torch.tensor([[0.0, 4, 0], [0.5, 4, 0], [1, 4, 0.3]])
    cameras = Cameras.looking_at(
        where, where - torch.tensor([0.0, 1, 0]), focal=20, width=16, height=16
    )
    with pytest.raises(DevrfError, match="data.box=") as caught:
        axes_meet(cameras)
    assert "\n" not in str(caught.value)


def bounds_of(views: Views, **options: Any) -> Bounds:
    return inward_bounds(views, views, [views], GivenBounds(**options))


def test_source_says_where_the_motion_box_came_from(ball_views):
    places = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]])
    views = ball_views(places, 0.4)
    carved = bounds_of(views)
    assert carved.motion is not None and carved.source == "silhouettes of 4 views x 3 frames"
    fixed = bounds_of(views, scale=1.5)
    assert fixed.motion is None and fixed.source == "canonical box x bound scale 1.5"
    plain = bounds_of(ball_views(places, 0.4, channels=3))
    assert plain.motion is None and f"bound scale {FALLBACK_BOUND_SCALE}" in plain.source


@pytest.mark.parametrize("reach", [1.0, 1.5])
def test_the_box_holds_what_wide_images_show_beside_the_sphere_that_all_hold(ball_views, reach):
    """Images of 96x80 px: 1.49 from the middle are in all of them, and across them 1.93."""
    views = ball_views(torch.tensor([[reach, 0.0, 0.0]]), 0.25, count=8)
    bounds = inward_bounds(views, None, [views], GivenBounds())
    seen = box_from_cameras(views.cameras)
    ends = torch.tensor([[reach - 0.25, -0.25, -0.25], [reach + 0.25, 0.25, 0.25]])
    assert bool(bounds.box.contains(ends).all()) and bounds.box.union(seen) == bounds.box
    assert bounds.box_source.endswith("silhouettes") == (bounds.box != seen) == (reach == 1.5)
    plain = replace(views, pixels=views.pixels[..., :3])
    assert inward_bounds(plain, None, [plain], GivenBounds()).box == seen


def test_near_and_far_hold_for_what_moves_beyond_the_box(ball_views):
    views = ball_views(torch.tensor([[0.0, 0, 0], [0.9, 0, 0]]), 0.3)
    small = Box((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4)).scaled(2.0)
    carved, plain = bounds_of(views, box=small), bounds_of(views, box=small, scale=1.0)
    assert carved.motion is not None and carved.motion.high[0] > small.high[0]
    assert carved.near < plain.near and carved.far > plain.far


PLACES = torch.tensor([[0.0, 0, 0], [0.3, 0, 0]])
BOX = Box((-0.5, -0.4, -0.3), (0.6, 0.7, 0.8))


def chosen(views: Views, choice: Any = "auto", **options: Any) -> tuple[Space, Bounds]:
    return inward_space(choice, views, views, [views], GivenBounds(**options))


def test_alpha_masks_and_a_given_box_mean_the_world(ball_views: Callable[..., Views]) -> None:
    space, bounds = chosen(ball_views(PLACES, 0.4))
    assert space == WORLD and bounds.reason == "the images have alpha masks" and not bounds.limited
    space, bounds = chosen(ball_views(PLACES, 0.4, channels=3), box=BOX)
    assert space == WORLD and bounds.reason == "data.box is given"
    assert bounds.box == BOX and bounds.limited and "data.box" in bounds.source
    assert bounds.given.box == BOX and chosen(ball_views(PLACES, 0.4))[1].given.box is None


def test_without_alpha_masks_the_scene_is_unbounded(ball_views: Callable[..., Views]) -> None:
    views = ball_views(PLACES, 0.4, channels=3)
    space, bounds = chosen(views)
    assert isinstance(space, ContractedSpace) and space.shell == SHELL
    assert bounds.reason == "the images have no alpha masks, data.box is not given"
    assert bounds.box == space.box and bounds.far == math.inf
    # The inner box is what all cameras see: in their pictures as a whole.
    assert space.inner(bounds.box).longest < 0.75 * bounds.box.longest
    nearest = float(views.cameras.positions.norm(dim=1).min())
    assert bounds.near == pytest.approx(NEAR_SHARE * nearest, rel=1e-3)


def test_a_given_box_is_the_inner_box(ball_views: Callable[..., Views]) -> None:
    views = ball_views(PLACES, 0.4)
    space, bounds = chosen(views, "contracted", box=BOX, near=0.2)
    assert space.inner(bounds.box) == BOX and bounds.near == 0.2
    wider = chosen(ball_views(PLACES, 0.4, channels=3), scale=2.0)[1].box
    assert wider.longest == pytest.approx(
        2 * chosen(ball_views(PLACES, 0.4, channels=3))[1].box.longest
    )
    space, bounds = chosen(views, "contracted", box=BOX, scale=2.0)
    assert space.inner(bounds.box) == BOX.scaled(2.0) and bounds.box_source.endswith("x 2")
    with pytest.raises(DevrfError, match="data.near"):
        chosen(views, "contracted", near=math.inf)
    with pytest.raises(DevrfError, match=r"not 9 and 3; the cameras say data.near=\S+ data.far="):
        chosen(views, "world", near=9.0, far=3.0)


def film(views: Views, **options: Any) -> Scene:
    """A scene whose captures are both the same images, each from a place of its own."""
    views = replace(views, view=torch.arange(len(views)))
    space, bounds = chosen(views, "contracted", **options)
    capture = Capture(train=views, test=views)
    return Scene("film", "inward", capture, capture, bounds, "white", space)


def test_without_its_static_set_a_scene_keeps_bounds_that_it_does_not_owe_to_it(
    ball_views: Callable[..., Views],
) -> None:
    views = ball_views(PLACES, 0.4, channels=3)
    scene = film(views, scale=2.0)
    alone = dynamic_only(scene)
    assert alone.bounds == scene.bounds and alone.space == scene.space
    assert alone.static.train.times.tolist() == [0.0] * 4
    assert scene.is_monocular

    moved = views.cameras.camera_to_world.clone()
    moved[:, :, 3] *= 2
    cameras = replace(views.cameras, camera_to_world=moved)
    farther = replace(views, cameras=cameras, names=tuple(f"static {n}" for n in views.names))
    found = replace(film(farther), dynamic=scene.dynamic)
    assert not found.is_monocular
    assert dynamic_only(found).space == film(views).space != found.space
    given = replace(film(farther, box=BOX, near=0.2), dynamic=scene.dynamic)
    assert dynamic_only(given).bounds == given.bounds


@pytest.mark.parametrize("choice", ["world", "contracted"])
def test_without_its_static_set_a_scene_keeps_what_is_given(
    ball_views: Callable[..., Views], choice: str
) -> None:
    views = ball_views(PLACES, 0.4)
    given = GivenBounds(scale=2.0, near=0.5, far=20.0)
    space, bounds = inward_space(choice, views, views, [views], given)
    static = Capture(
        train=replace(views, names=tuple(f"static {n}" for n in views.names)), test=views
    )
    scene = Scene("ball", "inward", static, Capture(views, views), bounds, "white", space)
    alone = dynamic_only(scene)
    assert alone.bounds == scene.bounds and alone.space == scene.space
    assert alone.bounds.near == 0.5 and alone.bounds.far == (
        20.0 if choice == "world" else math.inf
    )


def test_cameras_that_look_in_one_direction_need_not_tell_where_a_given_box_is(
    ball_views: Callable[..., Views],
) -> None:
    views = ball_views(PLACES, 0.4, channels=3)
    where = views.cameras.positions
    parallel = Cameras.looking_at(
        where, where - torch.tensor([0.0, 1, 0]), focal=20, width=16, height=16
    )
    alone = dynamic_only(film(replace(views, cameras=parallel), box=BOX, near=0.2))
    assert alone.space.inner(alone.bounds.box) == BOX

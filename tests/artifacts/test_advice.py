"""Each problem is found on a scene that was made to have it, and none on a healthy one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.artifacts.advice import Advice, listed
from devrf.artifacts.camera_advice import box_points, widest_gap
from devrf.artifacts.inspection import inspect_scene
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Capture, OpticalFlow, Scene, Views


@pytest.fixture(scope="module")
def healthy() -> Scene:
    """A robot in 24×18 pixels: 16 static views all around, 2 moving views of 3 frames."""
    return ProceduralScene(
        shape="robot",
        width=24,
        height=18,
        static_views=16,
        static_test_views=2,
        train_views=2,
        frames=3,
        supersample=1,
    )()


def with_static(scene: Scene, **changes: Any) -> Scene:
    return replace(scene, static=replace(scene.static, **changes))


def with_dynamic(scene: Scene, **changes: Any) -> Scene:
    return replace(scene, dynamic=replace(scene.dynamic, **changes))


def posed(views: Views, poses: Tensor) -> Views:
    return replace(views, cameras=replace(views.cameras, camera_to_world=poses))


def turned(views: Views, image: int, degrees: float) -> Views:
    """One camera turned about its own up axis."""
    poses = views.cameras.camera_to_world.clone()
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    poses[image, :, :3] = poses[image, :, :3] @ turn
    return posed(views, poses)


def without_mattes(scene: Scene, box: Box | None = None) -> Scene:
    def opaque(capture: Capture) -> Capture:
        return Capture(
            *(replace(v, pixels=v.pixels[..., :3]) for v in (capture.train, capture.test))
        )

    bounds = replace(scene.bounds, box=box or scene.bounds.box)
    return replace(scene, static=opaque(scene.static), dynamic=opaque(scene.dynamic), bounds=bounds)


def painted(views: Views, image: int, value: list[int]) -> Views:
    pixels = views.pixels.clone()
    pixels[image] = torch.tensor(value, dtype=torch.uint8)
    return replace(views, pixels=pixels)


def flowing(scene: Scene, change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Scene:
    train = scene.dynamic.train
    assert train.flow is not None
    changed = OpticalFlow(*change(train.flow.vectors.clone(), train.flow.valid.clone()))
    return with_dynamic(scene, train=replace(train, flow=changed))


def only(scene: Scene) -> Advice:
    advice = inspect_scene(scene).advice
    assert len(advice) == 1, advice
    assert str(advice[0]) == f"{advice[0].where}: {advice[0].what}; {advice[0].remedy}"
    return advice[0]


def test_a_healthy_scene(healthy: Scene) -> None:
    assert inspect_scene(healthy).advice == ()


def test_no_held_out_view(healthy: Scene) -> None:
    none = healthy.static.test[torch.zeros(0, dtype=torch.long)]
    found = only(with_static(healthy, test=none))
    assert found.where == "static test set" and "no view" in found.what


def test_a_held_out_view_that_is_learned_from(healthy: Scene) -> None:
    train = healthy.dynamic.train
    found = only(with_dynamic(healthy, test=train[torch.tensor([0, 4])]))
    assert found.where == "dynamic test set"
    assert train.names[0] in found.what and train.names[4] in found.what


def test_the_same_camera_at_another_time_may_be_held_out(healthy: Scene) -> None:
    train = healthy.dynamic.train
    test = replace(train[torch.tensor([0])], times=torch.tensor([0.25]))
    assert inspect_scene(with_dynamic(healthy, test=test)).advice == ()


def test_a_camera_that_looks_away(healthy: Scene) -> None:
    train = turned(healthy.static.train, 3, 180)
    found = only(with_static(healthy, train=train))
    assert found.where == train.names[3] and "looks away" in found.what


def test_a_camera_that_looks_past_the_box(healthy: Scene) -> None:
    train = turned(healthy.static.train, 3, 75)
    found = only(with_static(healthy, train=train))
    assert found.where == train.names[3] and "in the picture" in found.what


def test_a_box_that_nobody_knows(healthy: Scene) -> None:
    guess = box_from_cameras(healthy.static.train.cameras)
    assert "data.box=" in only(without_mattes(healthy, guess)).remedy
    assert inspect_scene(without_mattes(healthy, guess.scaled(0.9))).advice == ()


def test_images_of_one_colour(healthy: Scene) -> None:
    scene = without_mattes(healthy, healthy.bounds.box.scaled(0.9))
    train = painted(scene.dynamic.train, 2, [90, 90, 91])
    found = only(with_dynamic(scene, train=train))
    assert found.where == train.names[2] and "one colour" in found.what


def test_an_empty_matte(healthy: Scene) -> None:
    train = painted(healthy.static.train, 5, [90, 0, 91, 0])
    found = only(with_static(healthy, train=train))
    assert found.where == train.names[5] and "matte is empty" in found.what


def test_mattes_in_some_sets_only(healthy: Scene) -> None:
    test = healthy.static.test
    scene = with_static(healthy, test=replace(test, pixels=test.pixels[..., :3]))
    assert only(scene).where == "static test set"


def test_mattes_that_tell_nothing(healthy: Scene) -> None:
    test = healthy.static.test
    pixels = test.pixels.clone()
    pixels[..., 3] = 255
    found = only(with_static(healthy, test=replace(test, pixels=pixels)))
    assert found.where == "static test set" and "opaque everywhere" in found.what


def test_times_that_begin_late(healthy: Scene) -> None:
    train = healthy.dynamic.train
    scene = with_dynamic(healthy, train=replace(train, times=0.1 + 0.9 * train.times))
    assert "begins at time 0.1" in only(scene).what


def test_a_time_with_fewer_views(healthy: Scene) -> None:
    train = healthy.dynamic.train
    left = [i for i in range(len(train)) if not (train.times[i] == 0.5 and train.view[i] == 1)]
    assert len(left) == len(train) - 1
    found = only(with_dynamic(healthy, train=train[torch.tensor(left)]))
    assert "time 0.5 without view 1" in found.what


def test_flow_that_is_valid_nowhere(healthy: Scene) -> None:
    scene = flowing(healthy, lambda vectors, valid: (vectors, valid & False))
    assert "valid on 0.0 %" in only(scene).what


def test_flow_longer_than_the_image(healthy: Scene) -> None:
    found = only(flowing(healthy, lambda vectors, valid: (vectors + 25.0, valid)))
    assert "longer than the image (24 px)" in found.what


def test_flow_that_is_not_a_number(healthy: Scene) -> None:
    scene = flowing(healthy, lambda vectors, valid: (vectors * float("nan"), valid))
    assert "not a number" in only(scene).what


def test_views_from_one_side(healthy: Scene) -> None:
    train = healthy.static.train
    near = (train.cameras.positions[:, 0] > 0).nonzero()[:, 0]
    assert "sector of" in only(with_static(healthy, train=train[near])).what


def ring(angles: list[float], height: float = 1.0) -> Cameras:
    at = torch.tensor(angles).deg2rad()
    positions = torch.stack([3 * at.cos(), 3 * at.sin(), torch.full_like(at, height)], dim=1)
    middle = torch.zeros(len(angles), 3)
    return Cameras.looking_at(positions, middle, focal=20.0, width=15, height=10)


@pytest.mark.parametrize(
    ("angles", "gap"),
    [([0, 90, 180, 270], 90), ([10, 20, 30], 340), ([0, 45, 90, 225, 270, 315], 135), ([7], 360)],
)
def test_the_widest_gap_by_hand(angles: list[float], gap: float) -> None:
    assert widest_gap(ring(angles), torch.zeros(3)) == pytest.approx(gap, abs=0.01)


def test_views_from_straight_above_have_no_side() -> None:
    assert widest_gap(ring([0, 10, 20], height=60.0), torch.zeros(3)) is None


def test_an_endless_box_is_cut_off_at_twice_the_near_plane(healthy: Scene) -> None:
    space = NormalizedDevice(24, 18, (12.0, 9.0), near=1.0)
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    bounds = replace(healthy.bounds, box=box, motion=None)
    scene = replace(healthy, kind="forward", space=space, bounds=bounds)
    corners = box_points(scene, box, (2, 2, 2))
    # With these focal lengths what is seen at depth 1 is 2 wide, at depth 2 twice that.
    torch.testing.assert_close(corners[1, 1, 0], torch.tensor([1.0, 1.0, -1.0]))
    torch.testing.assert_close(corners[0, 1, 1], torch.tensor([-2.0, 2.0, -2.0]))


def test_long_lists_are_cut_short() -> None:
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(k) for k in range(9)]) == "0, 1, 2 and 6 more"

"""Each problem is found on a scene that was made to have it, and none on a healthy one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.artifacts.inspection.advice import listed
from devrf.artifacts.inspection.report import inspect_scene
from devrf.geometry.box import Box
from devrf.scenes.bounds import box_from_cameras
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Capture, OpticalFlow, Scene, Views


@pytest.fixture(scope="module")
def healthy(tiny_recipe: ProceduralScene) -> Scene:
    """A robot in 24×18 pixels: 16 static views all around, 2 moving views of 3 frames."""
    return replace(tiny_recipe, static_views=16)()


def with_static(scene: Scene, **changes: Any) -> Scene:
    return replace(scene, static=replace(scene.static, **changes))


def with_dynamic(scene: Scene, **changes: Any) -> Scene:
    return replace(scene, dynamic=replace(scene.dynamic, **changes))


def turned(scene: Scene, degrees: float) -> Scene:
    """The fourth static camera turned about its own up axis."""
    views = scene.static.train
    poses = views.cameras.camera_to_world.clone()
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    poses[3, :, :3] = poses[3, :, :3] @ turn
    cameras = replace(views.cameras, camera_to_world=poses)
    return with_static(scene, train=replace(views, cameras=cameras))


def without_alpha(scene: Scene, box: Box | None = None) -> Scene:
    def opaque(capture: Capture) -> Capture:
        sets = (capture.train, capture.test)
        return Capture(*(replace(v, pixels=v.pixels[..., :3]) for v in sets))

    bounds = replace(scene.bounds, box=box or scene.bounds.box.scaled(0.9))
    return replace(scene, static=opaque(scene.static), dynamic=opaque(scene.dynamic), bounds=bounds)


def painted(views: Views, image: int, value: list[int]) -> Views:
    pixels = views.pixels.clone()
    pixels[image] = torch.tensor(value, dtype=torch.uint8)
    return replace(views, pixels=pixels)


def opaque_test_set(scene: Scene) -> Scene:
    pixels = scene.static.test.pixels.clone()
    pixels[..., 3] = 255
    return with_static(scene, test=replace(scene.static.test, pixels=pixels))


def rgb_test_set(scene: Scene) -> Scene:
    test = scene.static.test
    return with_static(scene, test=replace(test, pixels=test.pixels[..., :3]))


def no_test_set(scene: Scene) -> Scene:
    return with_static(scene, test=scene.static.test[torch.zeros(0, dtype=torch.long)])


def late(scene: Scene) -> Scene:
    train = scene.dynamic.train
    return with_dynamic(scene, train=replace(train, times=0.1 + 0.9 * train.times))


def one_image_missing(scene: Scene) -> Scene:
    train = scene.dynamic.train
    kept = ~((train.times == 0.5) & (train.view == 1))
    assert int(kept.sum()) == len(train) - 1
    return with_dynamic(scene, train=train[kept.nonzero()[:, 0]])


def one_colour(scene: Scene) -> Scene:
    scene = without_alpha(scene)
    return with_dynamic(scene, train=painted(scene.dynamic.train, 2, [90, 90, 91]))


def empty_alpha(scene: Scene) -> Scene:
    return with_static(scene, train=painted(scene.static.train, 5, [90, 0, 91, 0]))


def one_side(scene: Scene) -> Scene:
    train = scene.static.train
    return with_static(scene, train=train[(train.cameras.positions[:, 0] > 0).nonzero()[:, 0]])


def ambiguous(scene: Scene) -> Scene:
    marked = torch.arange(len(scene.static.train)) == 7
    return with_static(scene, train=replace(scene.static.train, ambiguous_orientation=marked))


def flowing(change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Callable[[Scene], Scene]:
    def changed(scene: Scene) -> Scene:
        train = scene.dynamic.train
        assert train.flow is not None
        flow = OpticalFlow(*change(train.flow.vectors, train.flow.valid))
        return with_dynamic(scene, train=replace(train, flow=flow))

    return changed


STATIC, DYNAMIC = "static training set", "dynamic training set"


@pytest.mark.parametrize(
    ("spoil", "where", "what"),
    [
        (no_test_set, "static test set", "no view"),
        (lambda scene: turned(scene, 180), "static train 003", "looks away"),
        (lambda scene: turned(scene, 75), "static train 003", "in the picture"),
        (one_side, STATIC, "sector of"),
        (one_colour, "frame 001 view 0", "one colour"),
        (empty_alpha, "static train 005", "alpha mask is empty"),
        (ambiguous, "static train 007", "EXIF orientation"),
        (rgb_test_set, "static test set", "without alpha masks"),
        (opaque_test_set, "static test set", "opaque everywhere"),
        (late, DYNAMIC, "begins at time 0.1"),
        (one_image_missing, DYNAMIC, "time 0.5 without view 1"),
        (
            flowing(lambda vectors, valid: (vectors, valid & False)),
            "optical flow",
            "valid on 0.0 %",
        ),
        (flowing(lambda vectors, valid: (vectors + 25, valid)), "flow of", "the image (24 px)"),
        (flowing(lambda vectors, valid: (vectors * math.nan, valid)), "flow of", "not a number"),
    ],
)
def test_a_problem(healthy: Scene, spoil: Callable[[Scene], Scene], where: str, what: str) -> None:
    (found,) = inspect_scene(spoil(healthy)).advice
    assert where in found.where and what in found.what
    assert str(found) == f"{found.where}: {found.what}; {found.remedy}"


def test_no_problem(healthy: Scene) -> None:
    assert inspect_scene(healthy).advice == ()


def test_held_out_views_that_are_learned_from(healthy: Scene) -> None:
    train = healthy.dynamic.train
    (found,) = inspect_scene(with_dynamic(healthy, test=train[torch.tensor([0, 4])])).advice
    assert found.where == "dynamic test set"
    assert train.names[0] in found.what and train.names[4] in found.what
    # The same camera at another time may be held out.
    test = replace(train[torch.tensor([0])], times=torch.tensor([0.25]))
    assert inspect_scene(with_dynamic(healthy, test=test)).advice == ()


def test_a_box_that_is_only_guessed(healthy: Scene) -> None:
    guess = box_from_cameras(healthy.static.train.cameras)
    (found,) = inspect_scene(without_alpha(healthy, guess)).advice
    assert "data.box=" in found.remedy
    assert inspect_scene(without_alpha(healthy, guess.scaled(0.9))).advice == ()


def test_long_lists_are_cut_short() -> None:
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(k) for k in range(9)]) == "0, 1, 2 and 6 more"

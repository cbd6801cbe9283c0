"""The embedded scenes: what they claim to know exactly is checked against their own surfaces."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural import Flower, ProceduralForwardScene, ProceduralScene, moved
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.rigs import dynamic_rig
from devrf.scenes.scene import Scene, Views

# Not square, so that a swap of the axes cannot hide.
INWARD = ProceduralScene(
    width=40, height=28, static_views=5, static_test_views=2, train_views=3, frames=4
)
FORWARD = ProceduralForwardScene(
    width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
)
RECIPES = {"robot": INWARD, "flower": replace(INWARD, shape="flower"), "plush": FORWARD}
Built = tuple[Any, Scene]


@cache
def rendered(name: str) -> Built:
    """A recipe and its scene."""
    return RECIPES[name], RECIPES[name]()


@pytest.fixture(params=RECIPES)
def built(request: pytest.FixtureRequest) -> Built:
    """A recipe and its scene."""
    return rendered(request.param)


@pytest.fixture(params=["robot", "flower"])
def inward(request: pytest.FixtureRequest) -> Built:
    """A recipe of an inward-facing scene, and the scene."""
    return rendered(request.param)


def all_views(scene: Scene) -> list[Views]:
    return [v for c in (scene.static, scene.dynamic) for v in (c.train, c.test)]


def seen_points(cameras: Cameras, depth: Tensor) -> Tensor:
    """The points (S, 3) where rays through pixel centres end."""
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


def test_views_are_ordered_time_major(built: Built) -> None:
    scene = built[1]
    train, test = scene.dynamic.train, scene.dynamic.test
    assert train.view.tolist() == [0, 1, 2] * 4 and test.view.tolist() == [0] * 4
    expected = torch.tensor([0.0, 1 / 3, 2 / 3, 1.0]).repeat_interleave(3)
    torch.testing.assert_close(train.times, expected)
    assert len(scene.clock) == 4
    if scene.kind == "inward":
        assert (len(scene.static.train), len(scene.static.test)) == (5, 2)
        assert train.pixels.shape == (12, 28, 40, 4)
    else:
        # Seven of eight are learned from: 10 = 8 + 2.
        assert (scene.name, len(scene.static.train), len(scene.static.test)) == ("plush", 8, 2)
        assert train.pixels.shape == (12, 28, 40, 3)


def test_depth_ends_on_the_surface(built: Built) -> None:
    recipe, scene = built
    shape = recipe.model()
    for views in all_views(scene):
        assert views.depth is not None
        for k, time in enumerate(views.times.tolist()):
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            assert len(points) > 50
            assert (shape.distance(points, time).abs() < 2 * HIT).all()


def test_flow_is_the_projected_scene_flow(built: Built) -> None:
    recipe, scene = built
    shape = recipe.model()
    for views in (scene.dynamic.train, scene.dynamic.test):
        assert views.flow is not None and views.depth is not None
        assert not views.flow.valid[views.times == 0].any()
        largest = 0.0
        for k in (views.times > 0).nonzero().flatten().tolist():
            assert torch.equal(views.flow.valid[k], views.depth[k].isfinite())
            time = float(views.times[k])
            # By hand, with numbers of the pinhole model rather than Cameras.project.
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            before = moved(shape, points, time, time - 1 / 3)
            pose = views.cameras.camera_to_world[k]
            local = (before - pose[:, 3]) @ pose[:, :3]
            focal, center = views.cameras.focal[k], views.cameras.center[k]
            x = center[0] - focal[0] * local[:, 0] / local[:, 2]
            y = center[1] + focal[1] * local[:, 1] / local[:, 2]
            row, column = views.flow.valid[k].nonzero().unbind(-1)
            expected = torch.stack([x - column - 0.5, y - row - 0.5], dim=-1)
            actual = views.flow.vectors[k, row, column]
            torch.testing.assert_close(actual, expected, atol=2e-3, rtol=0)
            largest = max(largest, float(actual.norm(dim=-1).max()))
        assert largest > 1.0


def test_the_same_recipe_gives_the_same_scene(built: Built) -> None:
    recipe, scene = built
    again = recipe()
    assert scene.fingerprint == again.fingerprint
    for one, other in zip(all_views(scene), all_views(again), strict=True):
        assert torch.equal(one.pixels, other.pixels)
    assert torch.equal(scene.dynamic.train.flow.vectors, again.dynamic.train.flow.vectors)


def test_flow_leads_to_the_same_color(inward: Built) -> None:
    # The images themselves agree: away from silhouettes, a pixel looks as it did where its
    # flow points to. The albedo alone is compared, so the lamp is off.
    counts = {"static_views": 1, "static_test_views": 1, "train_views": 1, "frames": 12}
    train = replace(inward[0], light=0.0, width=96, height=80, **counts)().dynamic.train
    errors, still = [], []
    for k in range(1, 12):
        inside = train.flow.valid[k] & (train.pixels[k, :, :, 3] == 255)
        row, column = inside.nonzero().unbind(-1)
        target = torch.stack([column, row], dim=-1) + 0.5 + train.flow.vectors[k, row, column]
        size = torch.tensor([96.0, 80.0])
        earlier = train.pixels[k - 1].permute(2, 0, 1)[None].float() / 255
        there = torch.nn.functional.grid_sample(
            earlier, (target / size * 2 - 1)[None, None], align_corners=False
        )[0, :, 0].T
        here = train.pixels[k, row, column].float() / 255
        unmoved = train.pixels[k - 3, row, column].float() / 255
        errors.append((there - here).abs().amax(dim=-1))
        still.append((unmoved - here).abs().amax(dim=-1))
    assert torch.cat(errors).median() < 0.04
    assert torch.cat(errors).mean() < 0.5 * torch.cat(still).mean()


def test_edges_are_antialiased(inward: Built) -> None:
    recipe, scene = inward
    assert set(scene.static.train.pixels[..., 3].unique().tolist()) == {0, 64, 128, 191, 255}
    # Straight alpha: a half-covered pixel is as bright as its neighbours, not half as bright.
    flat = replace(recipe, light=0.0, static_views=1, frames=2, height=40)()
    pixels = flat.static.train.pixels.float()
    edge, inner = pixels[pixels[..., 3] == 128], pixels[pixels[..., 3] == 255]
    assert edge[:, :3].mean() > 0.75 * inner[:, :3].mean()


def test_cameras_see_the_object_between_near_and_far_and_are_apart(inward: Built) -> None:
    scene = inward[1]
    for views in all_views(scene):
        seen = views.depth[views.depth.isfinite()]
        assert scene.bounds.near < float(seen.min()) <= float(seen.max()) < scene.bounds.far
    for capture in (scene.static, scene.dynamic):
        apart = torch.cdist(capture.train.cameras.positions, capture.test.cameras.positions)
        assert float(apart.min()) > 0.5


def test_rest_pose_alone_explains_later_frames_badly(inward: Built) -> None:
    pixels = inward[1].dynamic.train.pixels.float() / 255
    white = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    frames = white.view(4, 3, 28, 40, 3)
    psnr = -10 * (frames[1:] - frames[:1]).square().mean(dim=(1, 2, 3, 4)).log10()
    assert (psnr < 21).all() and psnr[-1] < 18


def test_static_views_show_the_first_frame() -> None:
    cameras, _ = dynamic_rig(2, width=24, height=32, reach=1.3)
    still = Filming(Flower(0.0), 1.3).pictures(cameras, 0.7).pixels
    assert torch.equal(still, Filming(Flower(), 1.3).pictures(cameras, 0.0).pixels)
    assert not torch.equal(still, Filming(Flower(), 1.3).pictures(cameras, 0.7).pixels)


@pytest.mark.parametrize(("width", "height"), [(48, 16), (16, 48)])
def test_the_whole_object_fits_into_any_format(width: int, height: int) -> None:
    scene = replace(INWARD, width=width, height=height, frames=3, supersample=1)()
    for views in all_views(scene):
        assert torch.equal(views.cameras.focal[:, 0], views.cameras.focal[:, 1])
        alpha = views.pixels[..., 3]
        border = torch.cat([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]], dim=1)
        assert not border.any()
        assert alpha.any(dim=-1).any(dim=-1).all()


@pytest.mark.parametrize(
    ("recipe", "key", "value", "said"),
    [
        (INWARD, "shape", "teapot", "robot"),
        (INWARD, "width", 4, "at least 8"),
        (INWARD, "height", 7.5, "whole number"),
        (INWARD, "static_test_views", -1, "at least 1"),
        (INWARD, "frames", True, "whole number"),
        (INWARD, "speed", -0.1, "0 … 2"),
        (INWARD, "light", "bright", "0 … 1"),
        (FORWARD, "frames", 1, "at least 2"),
        (FORWARD, "static_views", 0, "at least 1"),
        (FORWARD, "train_views", 0, "at least 1"),
        (FORWARD, "speed", float("nan"), "0 … 2"),
        (FORWARD, "light", 1.5, "0 … 1"),
        (FORWARD, "supersample", 17, "at most 16"),
    ],
)
def test_wrong_numbers_are_named(recipe: Any, key: str, value: object, said: str) -> None:
    with pytest.raises(DevrfError, match=f"data.{key}.*{said}") as caught:
        replace(recipe, **{key: value})()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["robot", "plush"])
def test_frames_may_be_left_to_the_held_out_camera(name: str) -> None:
    recipe, whole = rendered(name)
    partly = replace(recipe, novel_times_every=2)()
    # Of the frames 0, 1, 2, 3 the second is not learned from; the last one always is.
    assert partly.clock.times == pytest.approx((0.0, 2 / 3, 1.0))
    assert torch.equal(partly.dynamic.test.pixels, whole.dynamic.test.pixels)
    kept = whole.dynamic.train.frames != 1
    train = partly.dynamic.train
    assert torch.equal(train.pixels, whole.dynamic.train.pixels[kept])
    assert train.names == tuple(n for n in whole.dynamic.train.names if "frame 001" not in n)
    # Flow leads one learned frame back: the frame after the gap from 2/3 to 0.
    after, before = whole.dynamic.train[(train_place(whole, 2))], train[train_place(partly, 1)]
    assert torch.equal(after.pixels, before.pixels)
    assert not torch.equal(after.flow.vectors, before.flow.vectors)  # type: ignore[union-attr]


def train_place(scene: Scene, frame: int) -> Tensor:
    """The places of a frame's images among the training views."""
    assert scene.dynamic.train.frames is not None
    return (scene.dynamic.train.frames == frame).nonzero()[:, 0]


@pytest.mark.parametrize("every", [1, 4, 2.5, True])
def test_every_how_many_frames_can_be_held_out(every: Any) -> None:
    with pytest.raises(DevrfError, match=r"data.novel_times_every: must be a whole .* 2 … 3, or"):
        replace(INWARD, novel_times_every=every)()

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
from devrf.geometry.poses import average_pose
from devrf.geometry.rays import Rays
from devrf.scenes.procedural import (
    Flower,
    Plush,
    ProceduralForwardScene,
    ProceduralScene,
    Robot,
    Shape,
    moved,
)
from devrf.scenes.procedural.filming import Filming, extent
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.plush import BASE
from devrf.scenes.procedural.rigs import dynamic_rig, facing_dynamic_rig, facing_static_rig
from devrf.scenes.procedural.surroundings import FLOOR, WALL, Backdrop, Surrounded
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
    shape = recipe.filmed()
    for views in all_views(scene):
        assert views.depth is not None
        for k, time in enumerate(views.times.tolist()):
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            assert len(points) > 50
            assert (shape.distance(points, time).abs() < 2 * HIT).all()


def test_flow_is_the_projected_scene_flow(built: Built) -> None:
    recipe, scene = built
    shape = recipe.filmed()
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


def test_the_same_recipe_gives_the_same_scene() -> None:
    recipe, scene = rendered("robot")
    again = recipe()
    assert scene.fingerprint == again.fingerprint
    for one, other in zip(all_views(scene), all_views(again), strict=True):
        assert torch.equal(one.pixels, other.pixels)
    assert torch.equal(scene.dynamic.train.flow.vectors, again.dynamic.train.flow.vectors)


def test_flow_leads_to_the_same_color() -> None:
    # The images themselves agree: away from silhouettes, a pixel looks as it did where its
    # flow points to. The albedo alone is compared, so the lamp is off.
    counts = {"static_views": 1, "static_test_views": 1, "train_views": 1, "frames": 12}
    train = replace(INWARD, light=0.0, width=96, height=80, **counts)().dynamic.train
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
        (INWARD, "width", 4, "8, not 4"),
        (INWARD, "height", 7.5, "integer, not 7.5"),
        (FORWARD, "frames", 1, "2, not 1"),
        (FORWARD, "novel_times_every", 4, "frames=4"),
    ],
)
def test_wrong_numbers_are_named(recipe: Any, key: str, value: object, said: str) -> None:
    with pytest.raises(DevrfError, match=f"data.{key}.*{said}") as caught:
        replace(recipe, **{key: value})
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


@pytest.fixture(scope="module")
def scene() -> Scene:
    return rendered("plush")[1]


def pixel_rays(views: Views) -> tuple[Tensor, Rays, Tensor]:
    """Camera, ray and end (S, 3) of every pixel."""
    assert views.depth is not None
    camera = torch.arange(len(views)).repeat_interleave(views.height * views.width)
    rays = views.cameras.rays(camera, views.cameras.pixel_grid().repeat(len(views), 1))
    return camera, rays, rays.at(torch.arange(len(rays)), views.depth.flatten())


def test_every_ray_meets_something_beyond_the_bound_of_the_published_layout(scene: Scene) -> None:
    for views in all_views(scene):
        camera, _, seen = pixel_rays(views)
        assert bool(seen.isfinite().all())
        assert int(views.pixels.amax(dim=-1).min()) > 0
        _, depth = views.cameras.project(camera, seen)
        assert float(depth.min()) > 1 / 0.75


@pytest.mark.parametrize("count", [2, 7, 23])
def test_the_static_cameras_are_centred_and_face_the_scene(count: int) -> None:
    cameras = facing_static_rig(count, width=40, height=28)
    average = average_pose(cameras.camera_to_world.double())
    torch.testing.assert_close(average, torch.eye(3, 4).double(), atol=1e-6, rtol=0)
    assert bool((cameras.forwards[:, 2] < -0.98).all())


def test_surfaces_lie_in_the_box_and_on_the_ndc_rays_of_their_pixels(scene: Scene) -> None:
    assert (scene.bounds.near, scene.bounds.far) == (0.0, 1.0)
    for views in (scene.static.train, scene.dynamic.train):
        _, world, seen = pixel_rays(views)
        device = scene.space.from_world(seen)
        assert bool(scene.bounds.box.contains(device).all())
        along = 1 + scene.space.near / seen[:, 2]  # type: ignore[attr-defined]
        expected = scene.space.rays(world).at(torch.arange(len(world)), along)
        torch.testing.assert_close(device, expected, atol=1e-4, rtol=0)


ALONE = [Robot(), Flower(), Flower(2.0)]
SHAPES = [*ALONE, Surrounded(Plush(), Backdrop()), Surrounded(Plush(2.0), Backdrop())]
each_alone = pytest.mark.parametrize("shape", ALONE, ids=repr)
each_shape = pytest.mark.parametrize("shape", SHAPES, ids=repr)


def surface(shape: Shape, time: float) -> Tensor:
    """World points (S, 3) that three cameras see of the shape at ``time``."""
    if isinstance(shape, Surrounded):
        cameras, _ = facing_dynamic_rig(3, width=32, height=24)
        depth = Filming(shape, 9.0, 1, steps=400).pictures(cameras, time).depth
    else:
        cameras, _ = dynamic_rig(3, width=48, height=48, reach=1.4)
        depth = Filming(shape, 1.6, 1).pictures(cameras, time).depth
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


@pytest.mark.parametrize("time", [0.0, 0.13, 0.5, 1.0])
@each_shape
def test_forward_undoes_the_backward_warp_and_rests_at_zero(shape: Shape, time: float) -> None:
    points = surface(shape, time)
    assert len(points) > 300
    material = shape.material(points, time)
    torch.testing.assert_close(shape.forward(material, time), points, atol=1e-5, rtol=0)
    torch.testing.assert_close(shape.forward(material, 0.0), material.rest, atol=2e-6, rtol=0)


@pytest.mark.parametrize("time", [0.0, 0.6, 1.0])
@each_shape
def test_distance_never_exceeds_that_to_a_seen_surface_point(shape: Shape, time: float) -> None:
    # Sphere tracing is safe exactly when no step is longer than the way to any surface.
    seen = surface(shape, time)
    generator = torch.Generator().manual_seed(0)
    points = 3 * torch.rand(1000, 3, generator=generator) - 1.5
    if isinstance(shape, Surrounded):
        points = points + torch.tensor(BASE)
        points[:, 1].clamp_(min=FLOOR)
        points[:, 2].clamp_(min=WALL)
    nearest = torch.cdist(points, seen).amin(dim=1)
    assert (shape.distance(points, time) <= nearest + 2 * HIT).all()


@each_alone
def test_motion_stays_within_the_extent(shape: Robot | Flower) -> None:
    where = extent(shape)
    assert where.rest.contains(surface(shape, 0.0)).all()
    for time in (0.0, 0.13, 0.5, 0.77, 1.0):
        points = surface(shape, time)
        assert where.motion.contains(points).all()
        assert float(points.norm(dim=-1).max()) < where.reach


@pytest.mark.parametrize("shape", ALONE[:2], ids=repr)
def test_material_keeps_its_color_and_stays_on_the_surface_or_inside(shape: Shape) -> None:
    points = surface(shape, 0.5)
    then, before = shape.material(points, 0.5), moved(shape, points, 0.5, 0.3)
    # A moved surface point may be swallowed by another part, but never leaves the object.
    assert (shape.distance(before, 0.3) < 3 * HIT).all()
    # Where the point is still the surface then, the scene has the same colour there.
    now = shape.material(before, 0.3)
    same = now.part == then.part
    assert same.float().mean() > 0.95
    torch.testing.assert_close(shape.color(now)[same], shape.color(then)[same], atol=1e-3, rtol=0)

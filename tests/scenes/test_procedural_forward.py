"""The embedded forward-facing scene: what it claims is checked against its own surfaces."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.average_pose import average_pose
from devrf.scenes.procedural import Plush, ProceduralForwardScene, moved
from devrf.scenes.procedural.backdrop import FLOOR, WALL, OnStage
from devrf.scenes.procedural.facing_rig import dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.plush_parts import BASE, REACH
from devrf.scenes.scene import Scene, Views

TIMES = (0.0, 0.13, 0.4, 0.77, 1.0)
SHAPES = [OnStage(Plush()), OnStage(Plush(2.0))]
# Not square, so that a swap of the axes cannot hide.
RECIPE = ProceduralForwardScene(
    width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return RECIPE()


def seen(views: Views) -> Tensor:
    """The points (S, 3) where all rays through pixel centres end."""
    assert views.depth is not None
    camera = torch.arange(len(views)).repeat_interleave(views.height * views.width)
    rays = views.cameras.rays(camera, views.cameras.pixel_grid().repeat(len(views), 1))
    return rays.at(torch.arange(len(rays)), views.depth.flatten())


def surface(shape: OnStage, time: float) -> Tensor:
    cameras, _ = dynamic_rig(3, width=32, height=24)
    filming = Filming(shape, 9.0, 1, 0.0, steps=400)
    depth = filming.pictures(cameras, time).depth
    camera = torch.arange(3).repeat_interleave(32 * 24)
    rays = cameras.rays(camera, cameras.pixel_grid().repeat(3, 1))
    return rays.at(torch.arange(len(rays)), depth.flatten())


def all_views(scene: Scene) -> list[Views]:
    return [v for c in (scene.static, scene.dynamic) for v in (c.train, c.test)]


def test_what_is_promised(scene):
    assert (scene.name, scene.kind) == ("plush", "forward")
    # Seven of eight are learned from: 10 = 8 + 2.
    assert len(scene.static.train) == 8 and len(scene.static.test) == 2
    assert len(scene.dynamic.train) == 12 and len(scene.dynamic.test) == 4
    assert scene.clock.times == pytest.approx((0, 1 / 3, 2 / 3, 1))
    assert scene.dynamic.train.view.tolist() == [0, 1, 2] * 4
    for views in all_views(scene):
        assert views.pixels.shape[1:] == (28, 40, 3)


def test_every_ray_meets_something(scene):
    for views in all_views(scene):
        assert views.depth is not None and bool(views.depth.isfinite().all())
        assert int(views.pixels.amax(dim=-1).min()) > 0


def test_every_ray_of_the_default_cameras_meets_something():
    cameras, _ = dynamic_rig(4, width=96, height=72)
    filming = Filming(ProceduralForwardScene().model(), 9.0, 1, 0.0, steps=400)
    assert bool(filming.pictures(cameras, 0.5).depth.isfinite().all())


@pytest.mark.parametrize("count", [2, 7, 23])
def test_the_static_cameras_are_centred_and_face_the_scene(count):
    cameras = static_rig(count, width=40, height=28)
    average = average_pose(cameras.camera_to_world.double())
    torch.testing.assert_close(average, torch.eye(3, 4).double(), atol=1e-6, rtol=0)
    assert bool((cameras.forwards[:, 2] < -0.98).all())


def test_nothing_is_nearer_than_the_bound_of_the_published_layout(scene):
    for views in all_views(scene):
        camera = torch.arange(len(views)).repeat_interleave(views.height * views.width)
        _, depth = views.cameras.project(camera, seen(views))
        assert float(depth.min()) > 1 / 0.75


@pytest.mark.parametrize("shape", [(40, 28), (28, 40), (32, 32)])
def test_the_floor_stays_far_enough_in_images_of_any_shape(shape):
    cameras = static_rig(23, width=shape[0], height=shape[1])
    down = torch.tensor([[shape[0] / 2, shape[1]]], dtype=torch.float32).repeat(23, 1)
    rays = cameras.rays(torch.arange(23), down)
    reach = (FLOOR - rays.origins[:, 1]) / rays.directions[:, 1]
    assert float((reach * -rays.directions[:, 2]).min()) > 1 / 0.75


def test_the_box_holds_every_visible_surface(scene):
    for views in (scene.static.train, scene.dynamic.train):
        device = scene.space.from_world(seen(views))
        assert bool(scene.bounds.box.contains(device).all())
    assert (scene.bounds.near, scene.bounds.far) == (0.0, 1.0)


def test_points_lie_on_the_ndc_rays_of_their_pixels(scene):
    views = scene.dynamic.train
    camera = torch.arange(len(views)).repeat_interleave(28 * 40)
    world = views.cameras.rays(camera, views.cameras.pixel_grid().repeat(len(views), 1))
    points = seen(views)
    rays = scene.space.rays(world)
    along = 1 + scene.space.near / points[:, 2]  # type: ignore[attr-defined]
    expected = rays.at(torch.arange(len(rays)), along)
    torch.testing.assert_close(scene.space.from_world(points), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_nothing_has_moved_at_time_zero(shape):
    outline = shape.outline()
    torch.testing.assert_close(shape.forward(outline, 0.0), outline.rest, atol=2e-6, rtol=0)


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_forward_undoes_the_backward_warp(shape, time):
    points = surface(shape, time)
    material = shape.material(points, time)
    assert set(material.part.tolist()) >= {0, 1, 2, 3, 4}
    torch.testing.assert_close(shape.forward(material, time), points, atol=1e-5, rtol=0)
    still = material.part < 3
    assert torch.equal(material.rest[still], points[still])


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_distance_never_exceeds_that_to_a_seen_surface_point(shape, time):
    # Sphere tracing is safe exactly when no step is longer than the way to any surface.
    points = surface(shape, time)
    generator = torch.Generator().manual_seed(3)
    toy = points[shape.material(points, time).part >= 3]
    assert len(toy) > 100
    base = torch.tensor(BASE)
    around = base + 1.7 * torch.randn(400, 3, generator=generator)
    around[:, 2] = around[:, 2].clamp_min(WALL)
    around[:, 1] = around[:, 1].clamp_min(FLOOR)
    nearest = torch.cdist(around, points).amin(dim=1)
    assert bool((shape.distance(around, time) <= nearest + HIT).all())


@pytest.mark.parametrize("speed", [0.0, 1.0, 2.0])
def test_the_toy_stays_in_the_ball_around_its_base(speed):
    toy = Plush(speed)
    outline = toy.outline()
    base = torch.tensor(BASE)
    assert float((outline.rest - base).norm(dim=1).max()) < REACH
    for time in torch.linspace(0, 1, 21).tolist():
        reach = REACH * toy._longest(time)
        assert float((toy.forward(outline, time) - base).norm(dim=1).max()) < reach


def test_flow_leads_to_the_same_material_in_the_frame_before(scene):
    views, shape = scene.dynamic.train, RECIPE.model()
    flow = views.flow
    assert flow is not None
    assert not bool(flow.valid[:3].any()) and bool(flow.valid[3:].all())
    pixels = views.cameras.pixel_grid()
    for image in range(3, 12):
        points = seen(views[torch.tensor([image])])
        time, earlier = float(views.times[image]), float(views.times[image - 3])
        before, _ = views.cameras.project_into(image, moved(shape, points, time, earlier))
        expected = (before - pixels).view(28, 40, 2)
        torch.testing.assert_close(flow.vectors[image], expected, atol=1e-4, rtol=0)
    # The toy moves by more than a pixel somewhere, the stage not at all.
    length = flow.vectors[3:].norm(dim=-1)
    assert 1 < float(length.max()) < 8
    assert float((length < 1e-3).float().mean()) > 0.6


def test_the_same_recipe_gives_the_same_scene(scene):
    again = replace(RECIPE, frames=2)()
    assert torch.equal(again.static.train.pixels, scene.static.train.pixels)
    assert torch.equal(again.dynamic.train.pixels[:3], scene.dynamic.train.pixels[:3])


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("frames", 1, "at least 2"),
        ("frames", 2.5, "whole number"),
        ("width", 4, "at least 8"),
        ("static_views", 0, "at least 1"),
        ("train_views", 0, "at least 1"),
        ("speed", 3.0, "0 … 2"),
        ("speed", float("nan"), "0 … 2"),
        ("light", -0.1, "0 … 1"),
        ("supersample", 17, "at most 16"),
    ],
)
def test_wrong_numbers_are_named(key, value, said):
    recipe = replace(RECIPE, **{key: value})  # type: ignore[arg-type]
    with pytest.raises(DevrfError, match=f"data.{key}.*{said}"):
        recipe()

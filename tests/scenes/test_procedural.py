"""The embedded scenes: what they claim to know exactly is checked against their own surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.geometry.poses import average_pose
from devrf.scenes.procedural import (
    Flower,
    Material,
    Plush,
    ProceduralForwardScene,
    ProceduralScene,
    Robot,
    Shape,
    moved,
)
from devrf.scenes.procedural.assembled import Assembled
from devrf.scenes.procedural.filming import Filming, covisible, extent
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.plush import BASE, REACH
from devrf.scenes.procedural.random_bodies import drawn_body, random_body
from devrf.scenes.procedural.rigs import STUDIO, dynamic_rig, facing_dynamic_rig, facing_static_rig
from devrf.scenes.procedural.solids import Body
from devrf.scenes.procedural.surroundings import FLOOR, WALL, Backdrop, Surrounded
from devrf.scenes.scene import Scene, Views

# Not square, so that a swap of the axes cannot hide.
SMALL = {"width": 28, "height": 20, "train_views": 2, "frames": 3, "supersample": 1}
INWARD = ProceduralScene(static_views=3, static_test_views=1, **SMALL)
FORWARD = ProceduralForwardScene(static_views=8, **SMALL)
HUNG = replace(FORWARD, shape="random", scene_seed=2)
RECIPES = {
    "robot": INWARD,
    "flower": replace(INWARD, shape="flower"),
    "plush": FORWARD,
    "random": HUNG,
}
Built = tuple[Any, Scene]


@cache
def rendered(name: str) -> Built:
    """A recipe and its scene."""
    return RECIPES[name], RECIPES[name]()


@pytest.fixture(params=RECIPES)
def built(request: pytest.FixtureRequest) -> Built:
    """A recipe and its scene."""
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
    assert train.view.tolist() == [0, 1] * 3 and test.view.tolist() == [0] * 3
    assert train.times.tolist() == [0, 0, 0.5, 0.5, 1, 1] and len(scene.clock) == 3
    # Of a forward-facing scene seven of eight are learned from: 10 = 8 + 2.
    counts = (3, 1, 4) if scene.kind == "inward" else (8, 2, 3)
    assert (len(scene.static.train), len(scene.static.test)) == counts[:2]
    assert train.pixels.shape == (6, 20, 28, counts[2])


def test_depth_ends_on_the_surface(built: Built) -> None:
    recipe, scene = built
    shape = recipe.visible_shape()
    for views in all_views(scene):
        assert views.depth is not None
        for k, time in enumerate(views.times.tolist()):
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            assert len(points) > 20
            assert (shape.distance(points, time).abs() < 2 * HIT).all()


def test_flow_is_the_projected_scene_flow(built: Built) -> None:
    recipe, scene = built
    shape = recipe.visible_shape()
    for views in (scene.dynamic.train, scene.dynamic.test):
        assert views.flow is not None and views.depth is not None
        assert not views.flow.valid[views.times == 0].any()
        largest = 0.0
        for k in (views.times > 0).nonzero().flatten().tolist():
            assert torch.equal(views.flow.valid[k], views.depth[k].isfinite())
            time = float(views.times[k])
            # By hand, with numbers of the pinhole model rather than Cameras.project.
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            before = moved(shape, points, time, time - 0.5)
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


def test_flow_leads_to_the_same_color() -> None:
    # The images themselves agree: away from silhouettes, a pixel looks as it did where its
    # flow points to. The albedo alone is compared, so the lamp is off.
    few = {"static_views": 1, "train_views": 1, "frames": 8, "width": 64, "height": 56}
    train = replace(INWARD, light=0.0, supersample=2, **few)().dynamic.train
    errors, still = [], []
    for k in range(1, 8):
        inside = train.flow.valid[k] & (train.pixels[k, :, :, 3] == 255)
        row, column = inside.nonzero().unbind(-1)
        target = torch.stack([column, row], dim=-1) + 0.5 + train.flow.vectors[k, row, column]
        earlier = train.pixels[k - 1].permute(2, 0, 1)[None].float() / 255
        there = torch.nn.functional.grid_sample(
            earlier,
            (target / torch.tensor([64.0, 56.0]) * 2 - 1)[None, None],
            align_corners=False,
        )[0, :, 0].T
        here = train.pixels[k, row, column].float() / 255
        errors.append((there - here).abs().amax(dim=-1))
        still.append((train.pixels[k - 2, row, column].float() / 255 - here).abs().amax(dim=-1))
    assert torch.cat(errors).median() < 0.06
    assert torch.cat(errors).mean() < 0.5 * torch.cat(still).mean()


def test_one_hand_held_camera_films_a_large_thing_and_others_see_it_at_the_same_times() -> None:
    recipe = replace(FORWARD, shape="cushion", camera="handheld", frames=5, width=40, height=30)
    scene = recipe()
    train, test = scene.dynamic.train, scene.dynamic.test
    assert scene.static.train is train and train.by_moving_camera
    assert train.times.tolist() == test.times.tolist() == [0, 0.25, 0.5, 0.75, 1]
    poses = torch.cat([v.cameras.camera_to_world for v in (train, test)])
    torch.testing.assert_close(average_pose(poses), torch.eye(4)[:3], atol=1e-5, rtol=0)
    assert train.valid_mask is None and 0.6 < float(test.valid_mask.float().mean()) < 1
    apart = (train.cameras.positions - test.cameras.positions).norm(dim=1)
    assert float(apart.min()) > 0.1
    backdrop = Backdrop()
    share = []
    for k in range(len(train)):
        points = seen_points(train.cameras[[k]], train.depth[[k]])
        share.append(float((backdrop.distances(points).amin(dim=0) > 0.01).float().mean()))
    assert 0.25 < sum(share) / len(share) < 0.45


def test_flow_of_a_hand_held_camera_leads_to_the_same_point_of_the_wall() -> None:
    recipe = replace(FORWARD, camera="handheld", frames=3, speed=0.0)
    train = recipe().dynamic.train
    flow = train.flow
    assert flow is not None and not flow.valid[0].any() and flow.valid[1:].all()
    points = seen_points(train.cameras[[1]], train.depth[[1]])
    before, _ = train.cameras.project(torch.zeros(len(points), dtype=torch.long), points)
    expected = before.view(*train.depth[1].shape, 2) - train.cameras.pixel_grid().view(
        *train.depth[1].shape, 2
    )
    torch.testing.assert_close(flow.vectors[1], expected, atol=1e-3, rtol=1e-3)
    assert float(flow.vectors[1].norm(dim=-1).mean()) > 1  # at rest, all that it sees flows


def test_a_pixel_is_covisible_if_five_images_show_its_point_or_half_or_a_tenth() -> None:
    recipe = replace(FORWARD, camera="handheld", frames=2, speed=0.0)
    surface = recipe.visible_shape()
    one = recipe().dynamic.train[torch.tensor([0])]

    def learned(count: int, hidden: int) -> Views:
        """The image ``count`` times; something is in front of all that ``hidden`` of them show."""
        views = one[torch.zeros(count, dtype=torch.long)]
        nearer = torch.tensor([0.5] * hidden + [1.0] * (count - hidden))
        return replace(views, depth=views.depth * nearer[:, None, None])

    cases = ((3, 1, 1), (3, 2, 0), (12, 7, 1), (12, 8, 0), (70, 63, 1), (70, 64, 0))
    for count, hidden, seen in cases:
        mask = covisible(surface, one, learned(count, hidden))
        assert mask.float().unique().tolist() == [seen], (count, hidden)
    aside = replace(one.cameras, center=one.cameras.center - torch.tensor([one.width / 2, 0.0]))
    half = replace(one, cameras=aside, depth=torch.full_like(one.depth, torch.inf))
    (mask,) = covisible(surface, one, half)
    middle = one.width // 2
    assert mask[:, middle:].all() and not mask[:, :middle].any()


def test_a_moving_point_is_covisible_where_it_has_gone() -> None:
    recipe = replace(FORWARD, shape="cushion", camera="handheld", frames=5, width=40, height=30)
    surface = recipe.visible_shape()
    train = recipe().dynamic.train
    first = train[torch.tensor([0])]
    last = train[torch.tensor([4])]
    rays = first.cameras.image_rays(0)
    points = rays.at(torch.arange(len(rays)), first.depth.flatten())
    there = surface.forward(surface.material(points, 0.0), 1.0)
    moved = (there - points).norm(dim=-1) > 0.02
    pixels, _ = last.cameras.project_into(0, there)
    x, y = pixels.long().unbind(-1)
    inside = (pixels.amin(dim=-1) >= 0) & (x < 40) & (y < 30) & moved
    # What is met in that pixel from there is the point itself, or something in front of it.
    away = (there - last.cameras.positions[0]).norm(dim=-1)[inside]
    shown = away <= 1.02 * last.depth[0][y[inside], x[inside]]
    mask = covisible(surface, first, last).flatten()
    assert moved.sum() > 100 and torch.equal(mask[inside], shown)


def test_edges_are_antialiased() -> None:
    flat = replace(INWARD, light=0.0, supersample=2, frames=2, width=40, height=40)()
    pixels = flat.static.train.pixels.float()
    assert set(pixels[..., 3].unique().tolist()) == {0, 64, 128, 191, 255}
    # Straight alpha: a half-covered pixel is as bright as its neighbours, not half as bright.
    edge, inner = pixels[pixels[..., 3] == 128], pixels[pixels[..., 3] == 255]
    assert edge[:, :3].mean() > 0.75 * inner[:, :3].mean()


@pytest.mark.parametrize(
    ("recipe", "key", "value", "said"),
    [
        (INWARD, "shape", "teapot", "robot"),
        (INWARD, "width", 4, "8, not 4"),
        (INWARD, "height", 7.5, "integer, not 7.5"),
        (FORWARD, "frames", 1, "2, not 1"),
        (FORWARD, "novel_times_every", 3, "frames=3"),
    ],
)
def test_wrong_numbers_are_named(recipe: Any, key: str, value: object, said: str) -> None:
    with pytest.raises(DevrfError, match=f"data.{key}.*{said}") as caught:
        replace(recipe, **{key: value})
    assert "\n" not in str(caught.value)


def test_frames_may_be_left_to_the_held_out_camera() -> None:
    recipe = replace(INWARD, frames=4)
    whole, partly = recipe(), replace(recipe, novel_times_every=2)()
    # Of the frames 0, 1, 2, 3 the second is not learned from; the last one always is.
    assert partly.clock.times == pytest.approx((0.0, 2 / 3, 1.0))
    assert torch.equal(partly.dynamic.test.pixels, whole.dynamic.test.pixels)
    train, every = partly.dynamic.train, whole.dynamic.train
    assert torch.equal(train.pixels, every.pixels[every.frames != 1])
    assert train.names == tuple(name for name in every.names if "frame 001" not in name)
    # Flow leads one learned frame back: the frame after the gap from 2/3 to 0.
    assert train.flow is not None and every.flow is not None
    assert not torch.equal(train.flow.vectors[2:4], every.flow.vectors[4:6])


@pytest.mark.parametrize("name", ["plush", "random"])
def test_every_ray_meets_something_beyond_the_bound_of_the_published_layout(name: str) -> None:
    for views in all_views(rendered(name)[1]):
        assert views.depth is not None and bool(views.depth.isfinite().all())
        assert int(views.pixels.amax(dim=-1).min()) > 0
        for k in range(len(views)):
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            assert float(views.cameras.project_into(k, points)[1].min()) > 1 / 0.75


def test_the_static_cameras_are_centred_and_face_the_scene() -> None:
    cameras = facing_static_rig(7, (40, 28))
    average = average_pose(cameras.camera_to_world.double())
    torch.testing.assert_close(average, torch.eye(3, 4).double(), atol=1e-6, rtol=0)
    assert bool((cameras.forwards[:, 2] < -0.98).all())


# Between them these have every kind of part and every way to move.
MAKERS: dict[str, Callable[[], Shape]] = {
    "robot": Robot,
    "flower": lambda: Flower(2.0),
    "random": lambda: random_body(3, 1.0, True),
    "loop": lambda: random_body(5),
    "plush": lambda: Surrounded(Plush(2.0), Backdrop(), REACH, BASE),
    "hung": lambda: HUNG.visible_shape(),
}
each_alone = pytest.mark.parametrize("shape", list(MAKERS)[:4], indirect=True)
each_shape = pytest.mark.parametrize("shape", MAKERS, indirect=True)


@cache
def made(name: str) -> Shape:
    """The shape of that name."""
    return MAKERS[name]()


@pytest.fixture
def shape(request: pytest.FixtureRequest) -> Shape:
    """The shape of a name, made when a test asks for it."""
    return made(request.param)


@cache
def surface(shape: Shape, time: float) -> Tensor:
    """World points (S, 3) that three cameras see of the shape at ``time``."""
    if isinstance(shape, Surrounded):
        cameras, _ = facing_dynamic_rig(3, (24, 18))
        depth = Filming(shape, 9.0, 1, opaque=True).pictures(cameras, time)[1]
    else:
        cameras, _ = dynamic_rig(3, (32, 32), reach=1.4)
        depth = Filming(shape, 1.6, 1).pictures(cameras, time)[1]
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


@pytest.mark.parametrize("time", [0.0, 0.6])
@each_shape
def test_forward_undoes_the_backward_warp_and_rests_at_zero(shape: Shape, time: float) -> None:
    points = surface(shape, time)
    assert len(points) > 90
    material = shape.material(points, time)
    torch.testing.assert_close(shape.forward(material, time), points, atol=1e-5, rtol=0)
    torch.testing.assert_close(shape.forward(material, 0.0), material.canonical, atol=2e-6, rtol=0)


@pytest.mark.parametrize("time", [0.0, 0.6])
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
def test_motion_stays_within_the_extent(shape: Body) -> None:
    where = extent(shape)
    assert where.canonical.contains(surface(shape, 0.0)).all()
    for time in (0.0, 0.6, 1.0):
        points = surface(shape, time)
        assert where.motion.contains(points).all()
        assert float(points.norm(dim=-1).max()) < where.reach


@pytest.mark.parametrize("seed", range(6))
def test_a_random_body_has_the_size_and_the_motion_that_are_said(seed: int) -> None:
    body = random_body(seed)
    outline = body.outline()
    size = outline.canonical.amax(dim=0) - outline.canonical.amin(dim=0)
    ways = [body.forward(outline, k / 12) - outline.canonical for k in range(13)]
    picture = 2 * STUDIO.distance * math.tan(STUDIO.field_of_view / 2)
    assert 0.15 <= float(size.max() / picture) ** 2 <= 0.7
    assert 0.09 < float(torch.stack(ways).norm(dim=-1).max() / size.max()) < 0.9
    other = random_body(seed + 1)
    assert len(other.parts) != len(body.parts) or other.parts[0].paint != body.parts[0].paint


def test_a_random_body_is_the_same_each_time() -> None:
    one, other = (drawn_body.__wrapped__(5) for _ in range(2))
    assert one is not other
    torch.testing.assert_close(one.outline().canonical, other.outline().canonical)


@pytest.mark.parametrize("seed", range(6))
def test_a_hung_body_touches_neither_wall_nor_floor(seed: int) -> None:
    hung = replace(HUNG, scene_seed=seed).visible_shape()
    assert isinstance(hung, Surrounded) and hung.surroundings.parts == 2
    body = hung.shape
    assert isinstance(body, Assembled)
    where = extent(body)
    assert where.motion.low[1] > FLOOR and where.motion.low[2] > WALL
    outline = body.outline()
    for time in (0.0, 0.4, 1.0):
        away = body.forward(outline, time) - torch.tensor(hung.center)
        assert float(away.norm(dim=1).max()) < hung.reach


@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_a_loop_stays_closed(time: float) -> None:
    bars = random_body(5).parts[:4]
    ends = torch.stack([bar.base + bar.along * bar.axes[:, 2] for bar in (bars[3], bars[0])])
    begins = torch.stack([bars[0].base, bars[1].base])
    rest = torch.cat([ends, begins]).float()
    moved_to = random_body(5).forward(Material(rest, torch.tensor([3, 0, 0, 1])), time)
    torch.testing.assert_close(moved_to[:2], moved_to[2:], atol=1e-5, rtol=0)


def test_sliding_texture_leaves_the_silhouette() -> None:
    scene = replace(INWARD, shape="random", scene_seed=5)
    attached, sliding = (scene.model(), replace(scene, sliding=True).model())
    points = surface(attached, 0.6)
    torch.testing.assert_close(sliding.distance(points, 0.6), attached.distance(points, 0.6))
    colors = [shape.color(shape.material(points, 0.6)) for shape in (attached, sliding)]
    assert float((colors[0] - colors[1]).abs().mean()) > 0.05

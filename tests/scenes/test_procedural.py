"""The embedded scenes: what they claim to know exactly is checked against their own surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras
from devrf.scenes.procedural import Flower, Material, ProceduralScene, Robot, Shape, moved
from devrf.scenes.procedural.cameras import dynamic_rig
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.picture import render
from devrf.scenes.procedural.robot import solid_motions
from devrf.scenes.procedural.truth import extent
from devrf.scenes.scene import Scene, Views

SHAPES = [Robot(), Flower(), Robot(2.0), Flower(2.0)]
TIMES = (0.0, 0.13, 0.5, 0.77, 1.0)
# Not square, so that a swap of the axes cannot hide.
RECIPE = ProceduralScene(
    width=40, height=28, static_views=5, static_test_views=2, train_views=3, frames=4
)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors: on a busy machine threads cost more than they bring."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module", params=["robot", "flower"])
def built(request) -> tuple[ProceduralScene, Scene]:
    recipe = replace(RECIPE, shape=request.param)
    return recipe, recipe()


def surface_points(shape: Shape, time: float) -> torch.Tensor:
    """World points that dynamic cameras see of the shape at ``time``."""
    cameras, _ = dynamic_rig(3, width=48, height=48, reach=1.4)
    depth = render(shape, cameras, time, reach=1.6, supersample=1, light=0.0).depth
    return seen_points(cameras, depth)


def seen_points(cameras: Cameras, depth: torch.Tensor) -> torch.Tensor:
    """The points (S, 3) where rays through pixel centres end."""
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


def test_every_robot_part_rests_at_time_zero():
    rest = solid_motions(1.3, 0.0)
    assert torch.equal(rest, torch.eye(3, 4, dtype=rest.dtype).expand_as(rest))


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_nothing_has_moved_at_time_zero(shape):
    outline = shape.outline()
    torch.testing.assert_close(shape.forward(outline, 0.0), outline.rest, atol=2e-6, rtol=0)


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_forward_undoes_the_backward_warp(shape, time):
    points = surface_points(shape, time)
    assert len(points) > 300
    again = shape.forward(shape.material(points, time), time)
    torch.testing.assert_close(again, points, atol=1e-5, rtol=0)


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_distance_never_exceeds_that_to_a_seen_surface_point(shape):
    # Sphere tracing is safe exactly when no step is longer than the way to any surface.
    generator = torch.Generator().manual_seed(0)
    points = 3 * torch.rand(2000, 3, generator=generator) - 1.5
    for time in (0.0, 0.6, 1.0):
        nearest = torch.cdist(points, surface_points(shape, time)).amin(dim=1)
        assert (shape.distance(points, time) <= nearest + 2 * HIT).all()


@pytest.mark.parametrize("shape", SHAPES[:2], ids=repr)
def test_material_stays_on_the_surface_or_inside(shape):
    # A moved surface point may be swallowed by another part, but never leaves the object.
    points = surface_points(shape, 0.4)
    assert (shape.distance(moved(shape, points, 0.4, 0.9), 0.9) < 3 * HIT).all()


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_motion_stays_within_the_extent(shape):
    where = extent(shape)
    assert where.rest.contains(surface_points(shape, 0.0)).all()
    for time in TIMES:
        points = surface_points(shape, time)
        assert where.motion.contains(points).all()
        assert float(points.norm(dim=-1).max()) < where.reach


def test_color_belongs_to_the_material():
    for shape in (Robot(), Flower()):
        points = surface_points(shape, 0.5)
        then = shape.material(points, 0.5)
        before = moved(shape, points, 0.5, 0.3)
        # Where the point is still the surface then, the scene has the same colour there.
        now = shape.material(before, 0.3)
        same = now.part == then.part
        assert same.float().mean() > 0.95
        torch.testing.assert_close(
            shape.color(now)[same], shape.color(then)[same], atol=1e-3, rtol=0
        )


def test_views_are_ordered_time_major(built):
    recipe, scene = built
    train = scene.dynamic.train
    assert train.view.tolist() == [0, 1, 2] * 4
    expected = torch.tensor([0.0, 1 / 3, 2 / 3, 1.0]).repeat_interleave(3)
    torch.testing.assert_close(train.times, expected)
    assert scene.dynamic.test.view.tolist() == [0] * 4
    assert (len(scene.static.train), len(scene.static.test)) == (5, 2)
    assert train.pixels.shape == (12, 28, 40, 4)
    assert len(scene.clock) == 4


def all_views(scene: Scene) -> list[Views]:
    return [c.__dict__[split] for c in (scene.static, scene.dynamic) for split in ("train", "test")]


def test_depth_ends_on_the_surface(built):
    recipe, scene = built
    shape = recipe.model()
    for views in all_views(scene):
        assert views.depth is not None
        for k, time in enumerate(views.times.tolist()):
            depth = views.depth[k : k + 1]
            points = seen_points(views.cameras[[k]], depth)
            assert len(points) > 50
            assert (shape.distance(points, time).abs() < 2 * HIT).all()
            seen = depth[depth.isfinite()]
            assert scene.bounds.near < float(seen.min()) <= float(seen.max()) < scene.bounds.far


def test_flow_is_the_projected_scene_flow(built):
    recipe, scene = built
    shape = recipe.model()
    for views in (scene.dynamic.train, scene.dynamic.test):
        assert views.flow is not None and views.depth is not None
        assert not views.flow.valid[views.times == 0].any()
        largest = 0.0
        for k, time in enumerate(views.times.tolist()):
            if time == 0:
                continue
            assert torch.equal(views.flow.valid[k], views.depth[k].isfinite())
            earlier = time - 1 / 3
            # By hand, with numbers of the pinhole model rather than Cameras.project.
            points = seen_points(views.cameras[[k]], views.depth[k : k + 1])
            before = moved(shape, points, time, earlier)
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


def test_flow_leads_to_the_same_color(built):
    # The images themselves agree: away from silhouettes, a pixel looks as it did where its
    # flow points to. The albedo alone is compared, so the lamp is off.
    recipe = replace(built[0], light=0.0, width=96, height=80, frames=12, static_views=1)
    train = recipe().dynamic.train
    assert train.flow is not None
    errors, still = [], []
    for k in range(3, 12):
        inside = train.flow.valid[k] & (train.pixels[k, :, :, 3] == 255)
        row, column = inside.nonzero().unbind(-1)
        target = torch.stack([column, row], dim=-1) + 0.5 + train.flow.vectors[k, row, column]
        size = torch.tensor([96.0, 80.0])
        earlier = train.pixels[k - 3].permute(2, 0, 1)[None].float() / 255
        there = torch.nn.functional.grid_sample(
            earlier, (target / size * 2 - 1)[None, None], align_corners=False
        )[0, :, 0].T
        here = train.pixels[k, row, column].float() / 255
        unmoved = train.pixels[k - 3, row, column].float() / 255
        errors.append((there - here).abs().amax(dim=-1))
        still.append((unmoved - here).abs().amax(dim=-1))
    assert torch.cat(errors).median() < 0.04
    assert torch.cat(errors).mean() < 0.5 * torch.cat(still).mean()


def test_edges_are_antialiased(built):
    alpha = built[1].static.train.pixels[..., 3]
    assert set(alpha.unique().tolist()) == {0, 64, 128, 191, 255}
    # Straight alpha: a half-covered pixel is as bright as its neighbours, not half as bright.
    flat = ProceduralScene(light=0.0, static_views=1, frames=2, width=40, height=40)()
    pixels = flat.static.train.pixels.float()
    edge, inner = pixels[pixels[..., 3] == 128], pixels[pixels[..., 3] == 255]
    assert edge[:, :3].mean() > 0.75 * inner[:, :3].mean()


def test_static_views_show_the_first_frame():
    shape = Flower()
    cameras, _ = dynamic_rig(2, width=24, height=32, reach=1.3)
    still = render(Flower(0.0), cameras, 0.7, reach=1.3)
    first = render(shape, cameras, 0.0, reach=1.3)
    assert torch.equal(still.pixels, first.pixels)
    later = render(shape, cameras, 0.7, reach=1.3)
    assert not torch.equal(later.pixels, first.pixels)


def test_rest_pose_alone_explains_later_frames_badly(built):
    pixels = built[1].dynamic.train.pixels.float() / 255
    white = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    frames = white.view(4, 3, 28, 40, 3)
    psnr = -10 * (frames[1:] - frames[:1]).square().mean(dim=(1, 2, 3, 4)).log10()
    assert (psnr < 21).all() and psnr[-1] < 18


def test_the_same_recipe_gives_the_same_scene(built):
    recipe, scene = built
    again = recipe()
    assert scene.fingerprint == again.fingerprint
    for one, other in zip(all_views(scene), all_views(again), strict=True):
        assert torch.equal(one.pixels, other.pixels)
    assert scene.dynamic.train.flow is not None and again.dynamic.train.flow is not None
    assert torch.equal(scene.dynamic.train.flow.vectors, again.dynamic.train.flow.vectors)


@pytest.mark.parametrize(("width", "height"), [(48, 16), (16, 48)])
def test_the_whole_object_fits_into_any_format(width, height):
    scene = ProceduralScene(
        width=width, height=height, frames=3, static_views=6, static_test_views=1, supersample=1
    )()
    for views in all_views(scene):
        assert torch.equal(views.cameras.focal[:, 0], views.cameras.focal[:, 1])
        alpha = views.pixels[..., 3]
        border = torch.cat([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]], dim=1)
        assert not border.any()
        assert alpha.any(dim=-1).any(dim=-1).all()


def test_held_out_cameras_are_not_training_cameras(built):
    for capture in (built[1].static, built[1].dynamic):
        apart = torch.cdist(capture.train.cameras.positions, capture.test.cameras.positions)
        assert float(apart.min()) > 0.5


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("shape", "teapot"),
        ("width", 4),
        ("height", 7.5),
        ("static_views", 0),
        ("static_test_views", -1),
        ("train_views", 0),
        ("frames", 1),
        ("frames", True),
        ("speed", -0.1),
        ("speed", float("nan")),
        ("supersample", 0),
        ("light", 1.5),
        ("light", "bright"),
    ],
)
def test_wrong_arguments_are_named(key, value):
    with pytest.raises(DevrfError, match=f"data.{key}") as caught:
        replace(RECIPE, **{key: value})()  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_material_is_named_by_part():
    # Two robot parts can share a point at rest and part ways: the part decides.
    shape = Robot()
    where = torch.zeros(2, 3)
    parts = Material(where, torch.tensor([0, 1]))
    fixed, turned = shape.forward(parts, 1.0)
    assert torch.equal(fixed, where[0])
    assert float((turned - fixed).norm()) > 1e-2

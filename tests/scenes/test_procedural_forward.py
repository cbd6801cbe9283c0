"""The embedded forward-facing scene: it is as a reader of LLFF would make it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.poses import average_pose
from devrf.geometry.rays import Rays
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.rigs import facing_dynamic_rig, facing_static_rig
from devrf.scenes.procedural.surroundings import FLOOR
from devrf.scenes.scene import Scene, Views


@pytest.fixture(scope="module")
def scene() -> Scene:
    # Not square, so that a swap of the axes cannot hide.
    return ProceduralForwardScene(
        width=40, height=28, static_views=8, train_views=3, frames=4, supersample=1
    )()


def all_views(scene: Scene) -> list[Views]:
    return [v for c in (scene.static, scene.dynamic) for v in (c.train, c.test)]


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


def test_every_ray_of_the_default_cameras_meets_something() -> None:
    cameras, _ = facing_dynamic_rig(4, width=96, height=72)
    film = Filming(ProceduralForwardScene().model(), 9.0, 1, 0.0, steps=400)
    assert bool(film.pictures(cameras, 0.5).depth.isfinite().all())


@pytest.mark.parametrize("count", [2, 7, 23])
def test_the_static_cameras_are_centred_and_face_the_scene(count: int) -> None:
    cameras = facing_static_rig(count, width=40, height=28)
    average = average_pose(cameras.camera_to_world.double())
    torch.testing.assert_close(average, torch.eye(3, 4).double(), atol=1e-6, rtol=0)
    assert bool((cameras.forwards[:, 2] < -0.98).all())


@pytest.mark.parametrize(("width", "height"), [(40, 28), (28, 40), (32, 32)])
def test_the_floor_stays_far_enough_in_images_of_any_shape(width: int, height: int) -> None:
    cameras = facing_static_rig(23, width=width, height=height)
    down = torch.tensor([[width / 2, float(height)]]).repeat(23, 1)
    rays = cameras.rays(torch.arange(23), down)
    reach = (FLOOR - rays.origins[:, 1]) / rays.directions[:, 1]
    assert float((reach * -rays.directions[:, 2]).min()) > 1 / 0.75


def test_surfaces_lie_in_the_box_and_on_the_ndc_rays_of_their_pixels(scene: Scene) -> None:
    assert (scene.bounds.near, scene.bounds.far) == (0.0, 1.0)
    for views in (scene.static.train, scene.dynamic.train):
        _, world, seen = pixel_rays(views)
        device = scene.space.from_world(seen)
        assert bool(scene.bounds.box.contains(device).all())
        along = 1 + scene.space.near / seen[:, 2]  # type: ignore[attr-defined]
        expected = scene.space.rays(world).at(torch.arange(len(world)), along)
        torch.testing.assert_close(device, expected, atol=1e-4, rtol=0)


def test_most_of_the_picture_stands_still(scene: Scene) -> None:
    flow = scene.dynamic.train.flow
    assert flow is not None and bool(flow.valid[3:].all())
    length = flow.vectors[3:].norm(dim=-1)
    assert float(length.max()) < 8
    assert float((length < 1e-3).float().mean()) > 0.6

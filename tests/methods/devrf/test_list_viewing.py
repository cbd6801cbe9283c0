"""Rendering on lists of a fixed length shows what the ordinary renderer shows."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import render
from devrf.ops.dispatch import using
from devrf.rendering import list_rendering as module
from devrf.rendering.list_rendering import ListRenderer
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import Renderer
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import Scene

WHITE = torch.ones(3)
Same = Callable[[RenderedImage, RenderedImage], None]
Picture = Callable[[DeVRFModel, Rays, float, torch.Tensor], RenderedImage]


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The capacity of each search for samples."""
    capacities: list[int] = []
    inner: Callable[..., object] = module.search

    def counted(*arguments: object, capacity: int, **named: object) -> object:
        capacities.append(capacity)
        return inner(*arguments, capacity=capacity, **named)

    monkeypatch.setattr(module, "search", counted)
    return capacities


@pytest.mark.parametrize("time", [0.0, 0.4, 0.7])
def test_what_the_renderer_shows(
    moving: DeVRFModel, tiny_scene: Scene, time: float, same: Same, reference: Picture
) -> None:
    rays, view = tiny_scene.dynamic.test.cameras.image_rays(0), moving.at(time)
    renderer = ListRenderer(moving.canonical, moving.settings, half=True)  # not on a CPU
    colors = moving.color_change(time)
    seen = renderer.picture(rays, view.occupancy, view.displacement, WHITE, colors)
    same(seen, reference(moving, rays, time, WHITE))
    assert int((seen.opacity > 0.5).sum()) > 20


def test_planes_of_a_forward_facing_scene(rng: torch.Generator, same: Same) -> None:
    box = Box((-1.0, -0.8, 0.0), (1.0, 0.8, 1.0))
    field = Architecture(channels=3, width=8, frequencies=0, planes=12).radiance_field(
        box, 12**3, 12**3
    )
    origins = torch.cat([torch.rand(30, 2, generator=rng) - 0.5, torch.zeros(30, 1)], dim=1)
    directions = torch.tensor([[0.2, -0.1, 1.0]]).expand(30, 3)
    rays = Rays(origins, directions, torch.nn.functional.normalize(directions, dim=1))
    settings = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.0, far=1.0)
    full = Occupancy.full((6, 6, 6), box)
    seen = ListRenderer(field, settings).picture(rays, full, None, WHITE)
    with torch.no_grad():
        same(seen, RenderedImage.of(render(rays, field, full, settings, WHITE)))
    assert seen.opacity.min() > 0.99  # the last plane is opaque


def test_lists_grow_once_and_stay(
    moving: DeVRFModel, tiny_scene: Scene, searches: list[int], same: Same
) -> None:
    rays = tiny_scene.dynamic.test.cameras.image_rays(0)
    renderer = ListRenderer(moving.canonical, moving.settings)
    first = renderer.picture(rays, moving.occupancy, None, WHITE)
    assert searches[0] == 0 and searches[1] > 0 and len(searches) == 2
    same(renderer.picture(rays, moving.occupancy, None, WHITE), first)
    assert searches[2:] == searches[1:2]


def test_rays_that_meet_nothing(moving: DeVRFModel) -> None:
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    rays = Rays(torch.tensor([[50.0, 0.0, 0.0]]).expand(3, 3), up, up)
    renderer = ListRenderer(moving.canonical, moving.settings)
    for some in (rays, rays[:0]):
        seen = renderer.picture(some, moving.occupancy, None, WHITE)
        assert torch.equal(seen.color, torch.ones(len(some), 3))
        assert not seen.depth.any() and not seen.opacity.any()


@pytest.mark.skipif(os.environ["TRITON_INTERPRET"] != "1", reason="needs Triton's interpreter")
@pytest.mark.parametrize("time", [0.0, 0.7])
def test_the_renderer_shows_the_same_with_triton(
    moving: DeVRFModel, tiny_scene: Scene, searches: list[int], time: float, same: Same
) -> None:
    pytest.importorskip("triton")
    renderer, cameras = Renderer(moving), tiny_scene.dynamic.test.cameras.resized(5, 4)
    with using("torch"):
        plain = renderer.view(cameras, 0, time, 1.0)
    assert not searches
    with using("triton"):
        same(renderer.view(cameras, 0, time, 1.0), plain)
    assert searches and (plain.opacity > 0.5).any()

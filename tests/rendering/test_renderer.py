"""A renderer renders what the model renders, and computes each time's view once."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from devrf.geometry.rays import Rays
from devrf.methods.devrf import view as module
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.rendered_image import RenderedImage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

WHITE = torch.ones(3)
Same = Callable[[RenderedImage, RenderedImage], None]
Picture = Callable[[DeVRFModel, Rays, float, torch.Tensor], RenderedImage]


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Has an entry for each time that an occupancy was computed."""
    found: list[int] = []
    inner: Callable[..., object] = module.occupancy_through

    def counted(*arguments: object) -> object:
        found.append(1)
        return inner(*arguments)

    monkeypatch.setattr(module, "occupancy_through", counted)
    return found


@pytest.mark.parametrize("time", [0.0, 0.4, 0.55, 1.0])
def test_it_renders_what_the_model_renders(
    moving: DeVRFModel, tiny_scene: Scene, time: float, same: Same, reference: Picture
) -> None:
    cameras = tiny_scene.dynamic.test.cameras
    seen = Renderer(moving).view(cameras, 1, time, 1.0)
    same(seen, reference(moving, cameras.image_rays(1), time, WHITE))
    assert 20 < int((seen.opacity > 0.5).sum()) < 24 * 18 / 2
    assert not seen.color.requires_grad


def test_a_view_has_the_occupancy_and_displacement_of_its_time(moving: DeVRFModel) -> None:
    view = moving.at(0.4)
    assert torch.equal(view.occupancy.mask, moving.occupancy_at(0.4).mask)
    assert not view.at_rest and view.displacement is not None
    assert moving.deformation is not None
    torch.testing.assert_close(view.displacement, moving.deformation.to_canonical[1])
    rest = moving.at(0.0)
    assert rest.at_rest and rest.occupancy is moving.occupancy and rest.displacement is None


def test_the_views_of_the_last_times_are_cached(moving: DeVRFModel, looks: list[int]) -> None:
    renderer = Renderer(moving, times=2)
    for time in (0.4, 0.7, 0.4, 0.7, 0.4):
        renderer.at(time)
    assert len(looks) == 2
    renderer.at(0.9)
    renderer.at(0.4)
    assert len(looks) == 3
    renderer.at(0.7)  # replaced by 0.9
    assert len(looks) == 4


def test_a_stream_is_rendered_image_by_image(
    moving: DeVRFModel, tiny_scene: Scene, looks: list[int], same: Same, reference: Picture
) -> None:
    cameras, renderer = tiny_scene.dynamic.test.cameras, Renderer(moving)
    stream = renderer.stream(cameras, [0.4, 0.4, 1.0], 0.0)
    assert len(looks) == 0
    first = next(stream)
    assert len(looks) == 1
    same(first, reference(moving, cameras.image_rays(0), 0.4, torch.zeros(3)))
    _, last = stream
    same(last, renderer.view(cameras, 2, 1.0, torch.zeros(3)))
    assert len(looks) == 2


def test_any_size_and_any_background(moving: DeVRFModel, tiny_scene: Scene) -> None:
    cameras = tiny_scene.dynamic.test.cameras.resized(60, 45)
    seen = Renderer(moving).view(cameras, 0, 1.0, torch.tensor([0.0, 1.0, 0.0]))
    assert seen.color.shape == (60 * 45, 3) and seen.depth.shape == (60 * 45,)
    empty = seen.opacity == 0
    assert empty.any()
    assert torch.equal(seen.color[empty][0], torch.tensor([0.0, 1.0, 0.0]))


def test_no_rays(moving: DeVRFModel, tiny_scene: Scene) -> None:
    rays = tiny_scene.dynamic.test.cameras.image_rays(0)[:0]
    assert Renderer(moving).picture(rays, 0.4, 1.0).color.shape == (0, 3)

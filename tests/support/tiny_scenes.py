"""Scenes of a few small images, and what serves them: fixtures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene
from devrf.scenes.scene import Scene, Views


@pytest.fixture(scope="session")
def tiny_recipe() -> ProceduralScene:
    """How the tiny scene is made; its ``model()`` knows every motion exactly."""
    return ProceduralScene(
        shape="robot",
        width=24,
        height=18,
        static_views=8,
        static_test_views=2,
        train_views=2,
        frames=3,
        supersample=1,
    )


@pytest.fixture(scope="session")
def tiny_scene(tiny_recipe: ProceduralScene) -> Scene:
    """A robot in 24×18 pixels (not square): 8 static views, 2 moving views of 3 frames."""
    return tiny_recipe()


@pytest.fixture(scope="session")
def tiny_toy() -> Scene:
    """A toy before a wall in 24×18 pixels: 7 static views, 3 moving views of 3 frames."""
    return ProceduralForwardScene(
        width=24, height=18, static_views=7, train_views=3, frames=3, supersample=1
    )()


@pytest.fixture(scope="session")
def tiny_room(tiny_recipe: ProceduralScene) -> Scene:
    """The tiny scene in a room: an unbounded scene whose images have no alpha masks."""
    return replace(tiny_recipe, surroundings="room")()


def cut(views: Views) -> Views:
    """The views with every second image cut to 18 of its columns, and the others to 16 rows."""
    height, width = views.pixels.shape[1:3]
    sizes = torch.tensor([[18, height], [width, 16]]).repeat(len(views), 1)[: len(views)]
    across = torch.arange(width) < sizes[:, :1, None]
    inside = across & (torch.arange(height) < sizes[:, 1:])[..., None]
    black = torch.tensor([0, 0, 0, 255], dtype=torch.uint8)[: views.pixels.shape[3]]
    flow = views.flow and replace(views.flow, valid=views.flow.valid & inside)
    return replace(
        views,
        pixels=torch.where(inside[..., None], views.pixels, black),
        cameras=replace(views.cameras, sizes=sizes),
        valid_mask=inside,
        flow=flow,
    )


@pytest.fixture(scope="session")
def two_sizes(tiny_scene: Scene) -> Scene:
    """The tiny scene with images of 18×18 and of 24×16 pixels in turn."""
    static, dynamic = tiny_scene.static.mapped(cut), tiny_scene.dynamic.mapped(cut)
    return replace(tiny_scene, static=static, dynamic=dynamic)


class GivenScene(SceneDataModule):
    """Serves a scene that is there already, and counts how often it was asked for."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.given, self.loads = scene, 0

    def load(self) -> Scene:
        """The scene."""
        self.loads += 1
        return self.given


@pytest.fixture(scope="session")
def serve() -> Callable[[Scene], SceneDataModule]:
    """``serve(scene)``: a datamodule of a scene that is there already."""
    return GivenScene


@pytest.fixture
def datamodule(tiny_scene: Scene) -> SceneDataModule:
    """Serves the tiny scene."""
    return GivenScene(tiny_scene)


@pytest.fixture(scope="session")
def four_frame_scene(tiny_recipe: ProceduralScene) -> Scene:
    """The tiny scene in 4 frames, of which the first and the last that move are no neighbours."""
    return replace(tiny_recipe, frames=4)()


@pytest.fixture
def four_frames(four_frame_scene: Scene) -> SceneDataModule:
    """Serves the tiny scene in 4 frames."""
    return GivenScene(four_frame_scene)

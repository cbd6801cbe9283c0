"""The flow that a scene implies: exact for an exact motion, and by hand for a moving block."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from devrf.evaluation.held_out_flow import flow_error, seen_flow
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import RenderSettings
from devrf.methods.devrf.view import DeVRFView
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.scenes.procedural import Material, ProceduralScene
from devrf.scenes.scene import OpticalFlow, Scene, Views

SETTINGS = RenderSettings(step=0.1, alpha_threshold=1e-4, near=0.0, far=99.0)
STEP = 0.004


class ExactField:
    """The procedural shape at rest: opaque inside, seen every STEP."""

    def __init__(self, scene: Scene, recipe: ProceduralScene) -> None:
        bounds = scene.bounds
        self.box = bounds.motion or bounds.box
        self.shape = recipe.model()
        self.density = SimpleNamespace(values=torch.zeros(()))

    def step_in_base_voxels(self, step: float) -> float:
        return 1.0

    def step_length(self, step: float) -> float:
        return STEP

    def optical_depth(self, points: Tensor, delta: float) -> Tensor:
        return 20.0 * (self.shape.distance(points, 0.0) < 0)

    def rgb(self, points: Tensor, *_: object) -> Tensor:
        return torch.zeros_like(points)


def exact_renderer(scene: Scene, recipe: ProceduralScene, *, moves: bool = True) -> Any:
    """What would show a model that knows the shape, and its motion if it ``moves``."""
    field, shape = ExactField(scene, recipe), recipe.model()

    def unwarp(points: Tensor, time: float) -> Tensor:
        part = shape.material(points, 0.0).part
        return shape.forward(Material(points, part), time)

    occupancy = Occupancy.full((12, 12, 12), field.box)
    lists: Any = SimpleNamespace(field=field, settings=SETTINGS)

    def at(time: float) -> DeVRFView:
        view: Any = DeVRFView(occupancy, None, lists, WORLD, time)
        if moves:
            view._motion = SimpleNamespace(unwarp=unwarp)
            view._warp = lambda points: shape.material(points, time).rest
        return view

    device = torch.device("cpu")
    return SimpleNamespace(model=SimpleNamespace(space=WORLD), device=device, at=at)


@pytest.mark.parametrize("index", [1, 2])
def test_the_exact_motion_of_a_procedural_scene_gives_its_exact_flow(
    tiny_scene: Scene, tiny_recipe: ProceduralScene, index: int
) -> None:
    views = tiny_scene.dynamic.test
    assert views.flow is not None
    truth = views.flow.vectors[index][views.flow.valid[index]]
    assert len(truth) > 40 and truth.norm(dim=1).mean() > 0.5
    flat = views.flow.valid[index].flatten().nonzero()[:, 0]
    renderer = exact_renderer(tiny_scene, tiny_recipe)
    errors = (seen_flow(renderer, views, index, index - 1, flat) - truth).norm(dim=1)
    # Where parts touch, a canonical point may belong to either: a few pixels go astray.
    assert errors.quantile(0.85) < 0.03 and errors.median() < 0.01
    assert flow_error(renderer, views, index) == pytest.approx(float(errors.mean()))
    # A scene that stays at rest is off by about the flow itself.
    at_rest = flow_error(exact_renderer(tiny_scene, tiny_recipe, moves=False), views, index)
    assert at_rest is not None and at_rest > 3 * float(errors.mean())


def test_without_flow_or_an_earlier_frame_it_is_unknown(
    tiny_scene: Scene, tiny_recipe: ProceduralScene
) -> None:
    views, renderer = tiny_scene.dynamic.test, exact_renderer(tiny_scene, tiny_recipe)
    assert flow_error(renderer, views, 0) is None
    assert flow_error(renderer, replace(views, flow=None), 1) is None
    assert views.flow is not None
    nowhere = OpticalFlow(views.flow.vectors, torch.zeros_like(views.flow.valid))
    assert flow_error(renderer, replace(views, flow=nowhere), 1) is None
    # A method whose views do not know where points go.
    renderer.at = lambda time: SimpleNamespace(chunk=1, at_rest=False, render=None)
    assert flow_error(renderer, views, 1) is None


SIDE = 21


@pytest.fixture
def block(cube: Box) -> DeVRFModel:
    """All below z = −0.05, halfway between two grid points, is solid.

    It moves by +0.2 along x until t = 0.5 and by +0.5 until t = 1.
    """
    build = Architecture()
    canonical = build.search_field(cube, SIDE**3)
    mask = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    mask[:, :, :10] = True
    with torch.no_grad():
        canonical.density.values[mask] = 400.0
        canonical.density.values[~mask] = -400.0
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=27)
    for frame, way in ((1, 0.2), (2, 0.5)):
        deformation.to_canonical[frame, ..., 0] = -way
        deformation.to_time[frame, ..., 0] = way
    return DeVRFModel(build, canonical, Occupancy.full((SIDE,) * 3, cube), SETTINGS, deformation)


def filmed_from_above(flow: tuple[float, float]) -> Views:
    """Three frames of a camera 4 above the face that looks down; x is to the right, y up."""
    pose = torch.eye(3, 4)
    pose[2, 3] = 3.95
    cameras = Cameras(
        pose[None].repeat(3, 1, 1), torch.full((3, 2), 40.0), torch.full((3, 2), 4.0), 8, 8
    )
    vectors = torch.tensor(flow).expand(3, 8, 8, 2).contiguous()
    return Views(
        torch.zeros(3, 8, 8, 3, dtype=torch.uint8),
        cameras,
        torch.tensor([0.0, 0.5, 1.0]),
        torch.zeros(3, dtype=torch.long),
        ("a", "b", "c"),
        OpticalFlow(vectors, torch.ones(3, 8, 8, dtype=torch.bool)),
    )


def test_a_moving_block_by_hand(block: DeVRFModel) -> None:
    # The face is 4 away, the lens has 40 px: 0.3 units along x are 3 px, and came from the left.
    views = filmed_from_above((-3.0, 1.0))
    seen = seen_flow(Renderer(block), views, 2, 1, torch.arange(64), chunk=10)
    torch.testing.assert_close(seen, torch.tensor([-3.0, 0.0]).expand(64, 2), atol=0.015, rtol=0)
    assert flow_error(Renderer(block), views, 2) == pytest.approx(1.0, abs=0.015)
    # From rest to the first frame: 2 px.
    views = filmed_from_above((-2.0, 0.0))
    assert flow_error(Renderer(block), views, 1) == pytest.approx(0, abs=0.015)


def test_a_scene_without_motion_or_matter_shows_none(block: DeVRFModel) -> None:
    views = filmed_from_above((-3.0, 4.0))
    block.deformation = None
    assert flow_error(Renderer(block), views, 2) == pytest.approx(5.0, abs=1e-3)
    with torch.no_grad():
        block.canonical.density.values.fill_(-400.0)
    assert flow_error(Renderer(block), views, 2) == pytest.approx(5.0)

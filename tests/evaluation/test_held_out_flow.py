"""The flow that a scene implies: by hand for a moving block, and when it is unknown.

That an exact motion implies the exact flow is for the tests of the motion losses.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.evaluation.held_out_flow import flow_error, seen_flow
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import RenderSettings
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import OpticalFlow, Views

SETTINGS = RenderSettings(step=0.1, alpha_threshold=1e-4, near=0.0, far=99.0)


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


def test_without_flow_or_an_earlier_frame_it_is_unknown(block: DeVRFModel) -> None:
    views, renderer = filmed_from_above((-3.0, 0.0)), Renderer(block)
    assert flow_error(renderer, views, 0) is None
    assert flow_error(renderer, replace(views, flow=None), 1) is None
    assert views.flow is not None
    nowhere = OpticalFlow(views.flow.vectors, torch.zeros_like(views.flow.valid))
    assert flow_error(renderer, replace(views, flow=nowhere), 1) is None
    # A method whose views have no motion.
    still: Any = SimpleNamespace(at=lambda time: SimpleNamespace(chunk=1, at_rest=False))
    assert flow_error(still, views, 1) is None

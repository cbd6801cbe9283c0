"""Where optical flow comes from when the user does not say."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from devrf.data import flow_source
from devrf.data.flow_source import with_flow
from devrf.geometry.cameras import Cameras
from devrf.scenes.optical_flow import camera_turn
from devrf.scenes.scene import Views


def circling(degrees: float, count: int = 6) -> Views:
    """A moving camera that goes round by ``degrees`` from an image to the next."""
    angle = torch.arange(count) * math.radians(degrees)
    positions = torch.stack([4 * angle.cos(), 4 * angle.sin(), 0 * angle], dim=1)
    cameras = Cameras.looking_at(positions, torch.zeros(count, 3), focal=60.0, width=40, height=32)
    pixels = torch.full((count, 32, 40, 3), 128, dtype=torch.uint8)
    return Views(
        pixels, cameras, torch.linspace(0, 1, count), torch.arange(count), tuple("abcdef"[:count])
    )


@pytest.mark.parametrize("degrees", [0.0, 5.0, 90.0])
def test_the_turn_is_the_angle_between_optical_axes(degrees):
    assert camera_turn(circling(degrees)) == pytest.approx(degrees, abs=0.1)


@pytest.mark.parametrize(("degrees", "estimated"), [(5.0, True), (40.0, False)])
def test_flow_between_cameras_that_jump_is_not_estimated(
    degrees, estimated, tiny_scene, monkeypatch
):
    asked: list[str] = []
    monkeypatch.setattr(
        flow_source, "estimate_flow", lambda views, method, cache: asked.append(method)
    )
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=circling(degrees)))
    with_flow(scene, "auto", None)
    assert asked == (["dis"] if estimated else [])

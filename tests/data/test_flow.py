"""Where optical flow comes from when the user does not say, and which image it leads to."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from devrf.data import flow
from devrf.data.flow import previous_images, with_flow
from devrf.geometry.cameras import Cameras
from devrf.scenes.optical_flow import camera_turn, frame_pairs
from devrf.scenes.scene import OpticalFlow, Views


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
    monkeypatch.setattr(flow, "estimate_flow", lambda views, method, cache: asked.append(method))
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=circling(degrees)))
    with_flow(scene, "auto", None)
    assert asked == (["dis"] if estimated else [])


def test_flow_is_estimated_only_where_it_is_asked_for(tiny_scene, monkeypatch):
    train = tiny_scene.dynamic.train
    bare = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=replace(train, flow=None)))
    made = OpticalFlow(torch.ones(6, 18, 24, 2), torch.ones(6, 18, 24, dtype=torch.bool))
    asked: list[str] = []
    monkeypatch.setattr(flow, "estimate_flow", lambda views, how, cache: asked.append(how) or made)
    assert with_flow(tiny_scene, "auto", None) is tiny_scene
    assert with_flow(bare, "none", None) is bare and with_flow(bare, "files", None) is bare
    assert asked == []
    assert with_flow(bare, "raft", None).dynamic.train.flow is made
    assert with_flow(tiny_scene, "dis", None).dynamic.train.flow is made
    assert asked == ["raft", "dis"]


@pytest.mark.parametrize(
    ("times", "view", "previous"),
    [
        # Fixed cameras, all at one moment, then all at the next; in another order.
        ([0.0, 0.0, 0.5, 0.5, 1.0, 1.0], [0, 1, 0, 1, 0, 1], [0, 1, 0, 1, 2, 3]),
        ([1.0, 0.0, 0.5, 0.0, 1.0, 0.5], [0, 0, 0, 1, 1, 1], [2, 1, 1, 3, 5, 3]),
        # A moving camera follows time alone.
        ([0.0, 0.3, 0.1, 1.0], [0, 1, 2, 3], [0, 2, 0, 1]),
        # A late start has no image at rest to lead to.
        ([0.4, 0.4, 0.8, 0.8], [0, 1, 0, 1], [0, 1, 0, 1]),
        # View 1 lacks frame 1; the only image of that frame is view 0's.
        ([0.0, 0.0, 0.5, 1.0, 1.0], [0, 1, 0, 0, 1], [0, 1, 0, 2, 4]),
    ],
)
def test_the_image_one_frame_earlier(times, view, previous):
    views = replace(circling(0.0, len(times)), times=torch.tensor(times), view=torch.tensor(view))
    assert previous_images(views).tolist() == previous
    assert [(i, p) for i, p in enumerate(previous) if p != i] == frame_pairs(views)

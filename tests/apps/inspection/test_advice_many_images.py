"""A scene of many images is looked at in time that grows as their number does."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.apps.inspection.advice import advice_on
from devrf.apps.inspection.picture import scene_lines
from devrf.geometry.cameras import Cameras
from devrf.scenes.scene import Capture, Scene, Views
from devrf.scenes.splits import distinct_poses

# Processor seconds: several times what it takes, and less than comparing each with each.
LIMIT = 1.5


def around(count: int, first: float) -> torch.Tensor:
    """Poses (count, 3, 4) that look at the origin from a circle, each from a place of its own."""
    angle = first + torch.arange(count, dtype=torch.float64) * 2.4
    height = torch.linspace(-1.0, 1.0, count, dtype=torch.float64)
    back = torch.stack([angle.cos(), angle.sin(), height], dim=1)
    back = back / back.norm(dim=1, keepdim=True)
    right = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]).double().expand(count, 3), back)
    right = right / right.norm(dim=1, keepdim=True)
    return torch.stack([right, torch.linalg.cross(back, right), back, 4 * back], dim=2)


def views(poses: torch.Tensor, name: str) -> Views:
    count = len(poses)
    cameras = Cameras(
        poses.float(), torch.full((count, 2), 8.0), torch.full((count, 2), 2.0), width=4, height=4
    )
    pixels = torch.arange(48, dtype=torch.uint8).view(1, 4, 4, 3).expand(count, 4, 4, 3)
    names = tuple(f"{name}{k}" for k in range(count))
    return Views(pixels, cameras, torch.zeros(count), torch.arange(count), names)


def seconds(work: Any) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


@pytest.fixture
def many(tiny_scene: Scene) -> Scene:
    """10,000 images at rest, 2,000 held out; the last of these is one to learn from."""
    poses = around(10_000, 0.0)
    held_out = torch.cat([around(1_999, 0.3), poses[4321:4322]])
    capture = Capture(views(poses, "train"), views(held_out, "test"))
    return replace(tiny_scene, static=capture, dynamic=capture)


def test_ten_thousand_images_take_seconds(many):
    found: list[Any] = []
    assert seconds(lambda: found.extend(advice_on(many))) < LIMIT
    twins = [advice.problem for advice in found if advice.where == "static test set"]
    assert len(twins) == 1 and twins[0].startswith("test1999: the same camera and time")
    assert not [advice for advice in found if "look" in advice.problem]
    assert seconds(lambda: scene_lines(many)) < LIMIT


def test_each_of_many_poses_is_found(many):
    poses = many.static.train.cameras.camera_to_world
    again = torch.cat([poses, poses[[3, 9_999]] + 1e-5])
    numbers: list[torch.Tensor] = []
    assert seconds(lambda: numbers.append(distinct_poses(again))) < LIMIT
    assert numbers[0].tolist() == [*range(10_000), 3, 9_999]

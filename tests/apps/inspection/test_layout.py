"""Where boxes and cameras are in the world."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.apps.inspection.layout import box_points, common_up, widest_gap
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.scene import Scene


def ring(angles: list[float], height: float = 1.0) -> Cameras:
    at = torch.tensor(angles).deg2rad()
    positions = torch.stack([3 * at.cos(), 3 * at.sin(), torch.full_like(at, height)], dim=1)
    middle = torch.zeros(len(angles), 3)
    return Cameras.looking_at(positions, middle, focal=20.0, width=15, height=10)


@pytest.mark.parametrize(
    ("angles", "gap"),
    [([0, 90, 180, 270], 90), ([10, 20, 30], 340), ([0, 45, 90, 225, 270, 315], 135), ([7], 360)],
)
def test_the_widest_gap_by_hand(angles: list[float], gap: float) -> None:
    assert widest_gap(ring(angles), torch.zeros(3)) == pytest.approx(gap, abs=0.01)


def test_views_from_straight_above_have_no_side() -> None:
    assert widest_gap(ring([0, 10, 20], height=60.0), torch.zeros(3)) is None


def test_up_of_level_cameras() -> None:
    up = common_up(ring([0, 70, 200]))
    assert up is not None
    torch.testing.assert_close(up, torch.tensor([0.0, 0.0, 1.0]), atol=1e-5, rtol=0)
    # Cameras that are each rolled by another angle agree on none.
    cameras = ring([0, 90, 180, 270])
    poses = cameras.camera_to_world.clone()
    poses[:2, :, :2] = poses[:2, :, [1, 0]] * torch.tensor([1.0, -1.0])
    assert common_up(replace(cameras, camera_to_world=poses)) is None


def test_an_endless_box_is_cut_off_at_twice_the_near_plane(tiny_scene: Scene) -> None:
    space = NormalizedDevice(24, 18, (12.0, 9.0), near=1.0)
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    scene = replace(tiny_scene, kind="forward", space=space)
    corners = box_points(scene, box, (2, 2, 2))
    # With these focal lengths the image at depth 1 is 2 wide, at depth 2 twice that.
    torch.testing.assert_close(corners[1, 1, 0], torch.tensor([1.0, 1.0, -1.0]))
    torch.testing.assert_close(corners[0, 1, 1], torch.tensor([-2.0, 2.0, -2.0]))

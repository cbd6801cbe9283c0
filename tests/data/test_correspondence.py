"""Which image the backward flow leads to: the same one in the loss and in flow estimation."""

from __future__ import annotations

import pytest
import torch

from devrf.data.correspondence import previous_images
from devrf.geometry.cameras import Cameras
from devrf.scenes.optical_flow import frame_pairs
from devrf.scenes.scene import Views


def views(times: list[float], view: list[int]) -> Views:
    count = len(times)
    cameras = Cameras(
        torch.eye(3, 4)[None].repeat(count, 1, 1), torch.ones(count, 2), torch.ones(count, 2), 2, 2
    )
    return Views(
        torch.zeros(count, 2, 2, 3, dtype=torch.uint8),
        cameras,
        torch.tensor(times),
        torch.tensor(view),
        tuple(map(str, range(count))),
    )


def previous(data: Views) -> list[int]:
    found: list[int] = previous_images(data).tolist()
    return found


def test_fixed_cameras_in_time_major_order():
    data = views([0.0, 0.0, 0.5, 0.5, 1.0, 1.0], [0, 1, 0, 1, 0, 1])
    assert previous(data) == [0, 1, 0, 1, 2, 3]


def test_the_order_of_the_images_does_not_matter():
    data = views([1.0, 0.0, 0.5, 0.0, 1.0, 0.5], [0, 0, 0, 1, 1, 1])
    assert previous(data) == [2, 1, 1, 3, 5, 3]


def test_a_moving_camera_follows_time_alone():
    assert previous(views([0.0, 0.3, 0.1, 1.0], [0, 1, 2, 3])) == [0, 2, 0, 1]


def test_a_late_start_has_no_image_at_rest_to_lead_to():
    assert previous(views([0.4, 0.4, 0.8, 0.8], [0, 1, 0, 1])) == [0, 1, 0, 1]


def test_a_missing_image_of_a_fixed_camera_is_not_replaced_by_another_camera():
    # View 1 lacks frame 1; the only image of that frame is view 0's.
    assert previous(views([0.0, 0.0, 0.5, 1.0, 1.0], [0, 1, 0, 0, 1])) == [0, 1, 0, 2, 4]


@pytest.mark.parametrize(
    ("times", "view"),
    [
        ([0.0, 0.0, 0.5, 0.5, 1.0, 1.0], [0, 1, 0, 1, 0, 1]),
        ([0.0, 0.0, 0.5, 1.0, 1.0], [0, 1, 0, 0, 1]),
        ([0.0, 0.3, 0.1, 1.0], [0, 1, 2, 3]),
        ([0.4, 0.8, 0.0], [0, 0, 0]),
        ([0.0, 0.5, 0.5, 1.0], [0, 1, 2, 3]),
    ],
)
def test_estimated_flow_leads_to_the_same_images(times, view):
    data = views(times, view)
    found = previous(data)
    assert [(i, p) for i, p in enumerate(found) if p != i] == frame_pairs(data)

"""Coloured points, of any scene that can be looked at."""

from __future__ import annotations

import pytest
import torch

from devrf.apps.export.geometry import seen_points
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.renderer import Renderer


@pytest.mark.parametrize(("time", "middle", "radius"), [(0.0, 0.0, 0.5), (1.0, 0.4, 0.6)])
def test_they_lie_on_the_ball_at_its_time(
    moving_ball: DeVRFModel, around: Cameras, time: float, middle: float, radius: float
) -> None:
    cloud = seen_points(Renderer(moving_ball), around, time, 1.0, 300)
    assert cloud.points.shape == cloud.colors.shape == (300, 3)
    away = (cloud.points - torch.tensor([middle, 0.0, 0.0])).norm(dim=1)
    # Light goes no deeper than a voxel, in the mean. They are all around the ball, and red.
    assert (away - radius).abs().mean() < 1 / 12
    assert (cloud.points[:, 1].amin() < -0.4) and (cloud.points[:, 1].amax() > 0.4)
    assert (cloud.colors[:, 0] > 0.95).all()


def test_none_where_none_are_seen(moving_ball: DeVRFModel, around: Cameras) -> None:
    far = Cameras.looking_at(
        100 * around.positions, 300 * around.positions, focal=60.0, width=48, height=36
    )
    assert len(seen_points(Renderer(moving_ball), far, 0.0, 1.0, 500).points) == 0

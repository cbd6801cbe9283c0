"""Fields whose surfaces and motion are known exactly."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings

RADIUS = 0.5
# s = log(eᵗ − 1) of the opacity 0.1 of a voxel: what the surface has by default.
LEVEL = math.log(math.expm1(-math.log(0.9)))


def solid(distance, box, side, color=(1.0, 0.0, 0.0), space=WORLD):
    """A scene at rest whose surface is where ``distance`` (M,) of points (M, 3) is 0.

    The raw density falls by 4 from a voxel to the next.
    """
    voxel = box.longest / (side - 1)
    voxels = round(box.volume / (box.longest / side) ** 3)
    field = Architecture().search_field(box, voxels)
    points = box.grid_points(field.density.shape, torch.empty(0))
    away = distance(points.view(-1, 3)).view(points.shape[:3])
    with torch.no_grad():
        field.density.values[..., 0] = LEVEL - field.shift - 4 * away / voxel
        field.color.values[:] = torch.logit(torch.tensor(color), eps=1e-4)
    settings = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.0, far=9.0)
    return DeVRFModel(Architecture(), field, Occupancy.full((2, 2, 2), box), settings, space=space)


def ball(points):
    """The distance to a ball about the origin."""
    return points.norm(dim=1) - RADIUS


@pytest.fixture(scope="module")
def of_distance():
    """The function :func:`solid`."""
    return solid


@pytest.fixture(scope="module")
def moving_ball(cube):
    """A red ball of radius 0.5 that moves by 0.4 along x and grows by a fifth until t = 1.

    Its motion is linear in space, so that trilinear displacements are exact.
    """
    model = solid(ball, cube, 25)
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=27)
    points = cube.grid_points(deformation.shape, torch.empty(0))
    for frame, time in ((1, 0.5), (2, 1.0)):
        shift = torch.tensor([0.4 * time, 0.0, 0.0])
        deformation.forward_slices[frame] = 0.2 * time * points + shift
        deformation.backward_slices[frame] = (points - shift) / (1 + 0.2 * time) - points
    model.deformation = deformation
    return model


@pytest.fixture(scope="module")
def around():
    """Six cameras that look at the origin from 4 units away, z up."""
    angle = torch.arange(6) * math.pi / 3
    places = torch.stack([4 * angle.cos(), 4 * angle.sin(), 0.5 + 0 * angle], dim=1)
    return Cameras.looking_at(places, torch.zeros(6, 3), focal=60.0, width=48, height=36)

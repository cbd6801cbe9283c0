"""A solid block that moves, and what sees it: fixtures."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import OpticalFlow, Views

GRID = 21
SETTINGS = RenderSettings(step=0.1, alpha_threshold=1e-4, near=0.0, far=99.0)


@pytest.fixture
def block(cube):
    """All below z = −0.05, halfway between two grid points, is solid.

    It moves by +0.2 along x until t = 0.5 and by +0.5 until t = 1.
    """
    build = Architecture()
    canonical = build.search_field(cube, GRID**3)
    mask = torch.zeros(GRID, GRID, GRID, dtype=torch.bool)
    mask[:, :, :10] = True
    with torch.no_grad():
        canonical.density.values[mask] = 400.0
        canonical.density.values[~mask] = -400.0
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=27)
    for frame, way in ((1, 0.2), (2, 0.5)):
        deformation.backward_slices[frame, ..., 0] = -way
        deformation.forward_slices[frame, ..., 0] = way
    return DeVRFModel(build, canonical, Occupancy.full((GRID,) * 3, cube), SETTINGS, deformation)


@pytest.fixture
def filmed_from_above() -> Callable[[tuple[float, float]], Views]:
    """Three frames, with a backward flow, of a camera 4 above the face that looks down.

    x is to the right, y up.
    """

    def filmed(flow: tuple[float, float]) -> Views:
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

    return filmed

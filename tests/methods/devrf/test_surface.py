"""What exports ask DeVRF for: the field at rest, and where its points go."""

from __future__ import annotations

import math

import torch

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings

SETTINGS = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.0, far=9.0)


def test_a_voxel_has_the_initial_opacity_where_something_may_be(cube: Box) -> None:
    mask = torch.zeros(5, 5, 5, dtype=torch.bool)
    mask[0] = True
    build = Architecture()
    model = DeVRFModel(build, build.search_field(cube, 5**3), Occupancy(mask, cube), SETTINGS)
    field = model.surface()
    assert (field.box, field.shape) == (cube, (5, 5, 5))
    depth = field.optical_depth(torch.tensor([[-1.0, 0.3, 0.0], [1.0, 0.3, 0.0]]))
    # A raw density of 0 gives a voxel 10⁻⁶.
    assert math.isclose(-math.expm1(-float(depth[0])), 1e-6, rel_tol=1e-2)
    assert depth[1] == 0
    # Without motion every point stays.
    assert torch.equal(model.forward_map(0.7)(depth[:, None]), depth[:, None])


def test_points_go_where_the_forward_displacements_lead(cube: Box) -> None:
    build = Architecture()
    motion = DeformationField(cube, FrameClock((0.0, 1.0)), voxels=27)
    motion.to_time[1, ..., 1] = 0.4
    model = DeVRFModel(
        build, build.search_field(cube, 5**3), Occupancy.full((2, 2, 2), cube), SETTINGS, motion
    )
    points = torch.tensor([[0.1, 0.2, 0.3]])
    assert torch.equal(model.forward_map(0.0)(points), points)
    moved = model.forward_map(0.5)(points)
    torch.testing.assert_close(moved, torch.tensor([[0.1, 0.4, 0.3]]))
    assert not moved.requires_grad

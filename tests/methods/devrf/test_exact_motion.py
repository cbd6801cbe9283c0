"""The deformation field filled with the exact motion of the embedded scenes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.scenes.procedural import Flower, Material, Shape
from devrf.scenes.procedural.cameras import dynamic_rig
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.robot import solid_motions

BOX = Box((-1.4, -1.4, -1.4), (1.4, 1.4, 1.4))
CLOCK = FrameClock((0.0, 1.0))


def test_a_rigid_part_goes_there_and_back_exactly(rng: torch.Generator) -> None:
    # A rigid motion is linear in the position: no grid is too coarse for it.
    motions = solid_motions(1.0, 1.0).float()
    motion = motions[(motions[:, :, :3] - torch.eye(3)).norm(dim=(1, 2)).argmax()]
    turn, way = motion[:, :3], motion[:, 3]
    assert (turn - torch.eye(3)).norm() > 0.3
    field = DeformationField(BOX, CLOCK, voxels=4**3)
    grid = BOX.grid_points(field.shape, way)
    field.to_time[1] = grid @ turn.T + way - grid
    field.to_canonical[1] = (grid - way) @ turn - grid
    rest = 0.4 * torch.rand(500, 3, generator=rng) - 0.2
    seen = rest @ turn.T + way
    assert BOX.contains(seen).all()
    torch.testing.assert_close(field.unwarp(rest, 1.0), seen, atol=1e-5, rtol=0)
    torch.testing.assert_close(field.warp(seen, 1.0), rest, atol=1e-5, rtol=0)
    torch.testing.assert_close(field.unwarp(field.warp(seen, 1.0), 1.0), seen, atol=1e-5, rtol=0)


def surface(shape: Shape) -> Tensor:
    """World points of ``shape`` at t = 1 that three cameras see."""
    cameras, _ = dynamic_rig(3, width=80, height=60, reach=1.4)
    depth = Filming(shape, 1.6, 1).pictures(cameras, 1.0).depth
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


def filled(shape: Shape, side: int) -> tuple[DeformationField, Tensor, Tensor]:
    """The field of the exact motion, and the part at each grid point at t = 1 and at rest."""
    field = DeformationField(BOX, CLOCK, voxels=side**3)
    grid = BOX.grid_points(field.shape, torch.zeros(())).reshape(-1, 3)
    seen, rest = shape.material(grid, 1.0), shape.material(grid, 0.0)
    field.to_canonical[1] = (seen.rest - grid).view(*field.shape, 3)
    forward = shape.forward(Material(grid, rest.part), 1.0)
    field.to_time[1] = (forward - grid).view(*field.shape, 3)
    return field, seen.part.view(field.shape), rest.part.view(field.shape)


def of_one_part(field: DeformationField, parts: Tensor, points: Tensor) -> Tensor:
    """Mask (M,): do all corners of the points' cells belong to one part?"""
    base = BOX.to_grid(points, field.shape).floor().long()
    offsets = torch.cartesian_prod(*[torch.arange(2)] * 3)
    i, j, k = (base[:, None] + offsets).unbind(-1)
    corners = parts[i, j, k]
    return (corners == corners[:, :1]).all(dim=1)


@pytest.fixture(scope="module")
def errors() -> dict[int, tuple[float, float, float]]:
    """Of a bending flower by grid side: mean errors of warp, unwarp and round trip."""
    shape, found = Flower(), {}
    points = surface(shape)
    material = shape.material(points, 1.0)
    inside: Tensor | None = None
    for side in (48, 24):
        field, seen_parts, rest_parts = filled(shape, side)
        # Where parts meet, motion jumps: there no interpolation can follow it.
        smooth = of_one_part(field, seen_parts, points)
        smooth &= of_one_part(field, rest_parts, material.rest)
        inside = smooth if inside is None else inside & smooth
        fields = (field, side)
        found[side] = fields
    assert inside is not None and int(inside.sum()) > 100
    points, rest = points[inside], material.rest[inside]
    result = {}
    for field, side in found.values():
        warped = field.warp(points, 1.0)
        result[side] = (
            float((warped - rest).norm(dim=1).mean()),
            float((field.unwarp(rest, 1.0) - points).norm(dim=1).mean()),
            float((field.unwarp(warped, 1.0) - points).norm(dim=1).mean()),
        )
    assert (points - rest).norm(dim=1).mean() > 0.1
    return result


def test_there_and_back_errs_by_no_more_than_both_interpolations(
    errors: dict[int, tuple[float, float, float]],
) -> None:
    for back, forth, both in errors.values():
        # The bending stretches by less than 2, so a warp's error counts no more than twice.
        assert both <= 2 * back + forth


def test_interpolation_is_of_second_order(errors: dict[int, tuple[float, float, float]]) -> None:
    # Twice the resolution leaves about a quarter of each error.
    for coarse, fine in zip(errors[24], errors[48], strict=True):
        assert fine < coarse / 3
        assert fine < 0.05 * BOX.longest / 47

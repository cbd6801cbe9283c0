"""The shapes of the embedded scenes: what they say of themselves holds on their own surfaces."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.scenes.procedural import Flower, Material, Plush, Robot, Shape, moved
from devrf.scenes.procedural.filming import Filming, extent
from devrf.scenes.procedural.march import HIT
from devrf.scenes.procedural.plush import BASE, REACH, TABLE
from devrf.scenes.procedural.rigs import dynamic_rig, facing_dynamic_rig
from devrf.scenes.procedural.surroundings import FLOOR, WALL, Backdrop, Surrounded

ALONE = [Robot(), Flower(), Robot(2.0), Flower(2.0)]
SHAPES = [*ALONE, Surrounded(Plush(), Backdrop()), Surrounded(Plush(2.0), Backdrop())]
each_alone = pytest.mark.parametrize("shape", ALONE, ids=repr)
each_shape = pytest.mark.parametrize("shape", SHAPES, ids=repr)


def surface(shape: Shape, time: float) -> Tensor:
    """World points (S, 3) that three cameras see of the shape at ``time``."""
    if isinstance(shape, Surrounded):
        cameras, _ = facing_dynamic_rig(3, width=32, height=24)
        depth = Filming(shape, 9.0, 1, steps=400).pictures(cameras, time).depth
    else:
        cameras, _ = dynamic_rig(3, width=48, height=48, reach=1.4)
        depth = Filming(shape, 1.6, 1).pictures(cameras, time).depth
    camera, row, column = depth.isfinite().nonzero().unbind(-1)
    rays = cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    return rays.at(torch.arange(len(rays)), depth[depth.isfinite()])


@pytest.mark.parametrize("time", [0.0, 0.13, 0.5, 1.0])
@each_shape
def test_forward_undoes_the_backward_warp_and_rests_at_zero(shape: Shape, time: float) -> None:
    points = surface(shape, time)
    assert len(points) > 300
    material = shape.material(points, time)
    torch.testing.assert_close(shape.forward(material, time), points, atol=1e-5, rtol=0)
    torch.testing.assert_close(shape.forward(material, 0.0), material.rest, atol=2e-6, rtol=0)


@pytest.mark.parametrize("time", [0.0, 0.6, 1.0])
@each_shape
def test_distance_never_exceeds_that_to_a_seen_surface_point(shape: Shape, time: float) -> None:
    # Sphere tracing is safe exactly when no step is longer than the way to any surface.
    seen = surface(shape, time)
    generator = torch.Generator().manual_seed(0)
    points = 3 * torch.rand(1000, 3, generator=generator) - 1.5
    if isinstance(shape, Surrounded):
        points = points + torch.tensor(BASE)
        points[:, 1].clamp_(min=FLOOR)
        points[:, 2].clamp_(min=WALL)
    nearest = torch.cdist(points, seen).amin(dim=1)
    assert (shape.distance(points, time) <= nearest + 2 * HIT).all()


@each_alone
def test_motion_stays_within_the_extent(shape: Robot | Flower) -> None:
    where = extent(shape)
    assert where.rest.contains(surface(shape, 0.0)).all()
    for time in (0.0, 0.13, 0.5, 0.77, 1.0):
        points = surface(shape, time)
        assert where.motion.contains(points).all()
        assert float(points.norm(dim=-1).max()) < where.reach


@pytest.mark.parametrize("shape", ALONE[:2], ids=repr)
def test_material_keeps_its_color_and_stays_on_the_surface_or_inside(shape: Shape) -> None:
    points = surface(shape, 0.5)
    then, before = shape.material(points, 0.5), moved(shape, points, 0.5, 0.3)
    # A moved surface point may be swallowed by another part, but never leaves the object.
    assert (shape.distance(before, 0.3) < 3 * HIT).all()
    # Where the point is still the surface then, the scene has the same colour there.
    now = shape.material(before, 0.3)
    same = now.part == then.part
    assert same.float().mean() > 0.95
    torch.testing.assert_close(shape.color(now)[same], shape.color(then)[same], atol=1e-3, rtol=0)


def test_the_stage_stands_still() -> None:
    shape = Surrounded(Plush(), Backdrop())
    points = surface(shape, 1.0)
    material = shape.material(points, 1.0)
    assert set(material.part.tolist()) >= {0, 1, 2, 3, 4}
    still = material.part < 3
    assert torch.equal(material.rest[still], points[still])


@pytest.mark.parametrize("speed", [0.0, 1.0, 2.0])
def test_the_toy_stays_in_the_ball_around_its_base(speed: float) -> None:
    toy, outline, base = Plush(speed), TABLE.outline(), torch.tensor(BASE)
    assert float((outline.rest - base).norm(dim=1).max()) < REACH
    for time in torch.linspace(0, 1, 21).tolist():
        there = toy.forward(outline, time)
        assert float((there - base).norm(dim=1).max()) < toy.reach(time)


def test_material_is_named_by_part() -> None:
    # Two robot parts can share a point at rest and part ways: the part decides.
    where = torch.zeros(2, 3)
    fixed, turned = Robot().forward(Material(where, torch.tensor([0, 1])), 1.0)
    assert torch.equal(fixed, where[0])
    assert float((turned - fixed).norm()) > 1e-2

"""Sizes of fields: how fine the grid of a forward-facing scene is, by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import (
    Architecture,
    fitted_to,
    resolved_planes,
    resolved_voxels,
)
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Scene

SPACE = NormalizedDevice(200, 100, (150.0, 120.0), near=1.0)


@pytest.mark.parametrize(
    ("apart", "near", "planes"),
    [
        (1.6, 1.0, 61),  # 150 · 1.6 / 1 = 240 pixels, 4 to each of 60 steps
        (0.01, 1.0, 32),  # hardly any parallax
        (50.0, 1.0, 256),
    ],
)
def test_planes_are_four_pixels_of_parallax_apart(apart, near, planes):
    # The distance along the line of sight does not count.
    positions = torch.tensor([[0.0, 0, 0], [0.6 * apart, 0.8 * apart, 9.0], [0.1 * apart, 0, 0]])
    assert resolved_planes(positions, replace(SPACE, near=near)) == planes


@pytest.fixture(scope="module")
def forward_scene() -> Scene:
    size = {"width": 24, "height": 18, "static_views": 6, "train_views": 1}
    return ProceduralForwardScene(**size, frames=2, supersample=1)()


def test_the_grid_has_so_many_points_to_a_pixel(forward_scene):
    schedule = CanonicalSchedule(side=30, upsample_at=(), voxels_per_pixel=0.5)
    fitted, sizes = fitted_to(forward_scene, schedule, Architecture(planes=40))
    box = forward_scene.bounds.box
    field = sizes.radiance_field(box, round(fitted.side**3), round(fitted.side**3))
    width, height, planes = field.density.shape
    # The box is wider than the reference image, which spans 2 units of NDC.
    assert width == pytest.approx(0.5 * 24 * box.size[0] / 2, abs=1)
    assert height == pytest.approx(0.5 * 18 * box.size[1] / 2, abs=1)
    assert planes == 40
    assert fitted.phases[-1].voxels == round(fitted.side**3)


def test_planes_are_told_by_the_scene_where_none_are_given(forward_scene):
    schedule = CanonicalSchedule(side=30, upsample_at=())
    asked = fitted_to(forward_scene, schedule, Architecture())
    assert asked == (schedule, Architecture(planes=32))
    given = Architecture(planes=7)
    assert fitted_to(forward_scene, schedule, given) == (schedule, given)


def test_a_scene_seen_from_all_around_keeps_its_numbers(tiny_scene):
    schedule = CanonicalSchedule(voxels_per_pixel=0.5)
    assert fitted_to(tiny_scene, schedule, Architecture()) == (schedule, Architecture())
    with pytest.raises(DevrfError, match=r"field\.planes=7: planes are of forward-facing scenes"):
        fitted_to(tiny_scene, schedule, Architecture(planes=7))


@pytest.mark.parametrize(
    ("side", "finer", "voxels"),
    [
        (80, 2.0, 20 * 10 * 10),  # half a pixel of 4 / 40 = 0.1
        (10, 2.0, 10**3),  # coarser than that as it is
        (80, None, 80**3),
        (80, 0.1, 8 * 2),  # whose first phase has half of them
    ],
)
def test_a_scene_seen_from_all_around_gets_what_its_pixels_resolve(side, finer, voxels):
    positions = torch.tensor([[4.0, 0, 0], [0, -4, 0], [0, 0, 9], [0, 0, 4], [0, 4, 0]])
    cameras = Cameras.looking_at(positions, torch.zeros(5, 3), focal=40.0, width=30, height=30)
    scene: Any = SimpleNamespace(space=WORLD, static=SimpleNamespace(train=None))
    scene.static.train = SimpleNamespace(cameras=cameras)
    schedule = CanonicalSchedule(side=side, upsample_at=(1000,), voxels_per_pixel=finer)
    box = Box((-0.5, -0.25, -0.25), (0.5, 0.25, 0.25))
    assert resolved_voxels(scene, schedule, box) == pytest.approx(voxels, abs=1)


@pytest.mark.parametrize(("side", "told"), [(12, False), (40, True)])
def test_voxels_far_finer_than_pixels_are_warned_of(side, told, caplog):
    cameras = Cameras.looking_at(
        torch.tensor([[4.0, 0, 0]]), torch.zeros(1, 3), focal=40.0, width=30, height=30
    )
    scene: Any = SimpleNamespace(space=WORLD, static=SimpleNamespace(train=None))
    scene.static.train = SimpleNamespace(cameras=cameras)
    box = Box((-0.5, -0.25, -0.25), (0.5, 0.25, 0.25))
    # Pixels of 0.1, voxels of (1 / 4)^(1 / 3) / side: 1.9 and 6.3 to one.
    assert resolved_voxels(scene, CanonicalSchedule(side=side, upsample_at=()), box) == side**3
    assert ("learns single rays" in caplog.text) is told


def test_planes_of_both_fields(forward_scene, fit, serve):
    data = serve(forward_scene)
    schedule = CanonicalSchedule(0, 8, iterations=10, side=12, upsample_at=(), rays=16)
    sizes, loss = Architecture(4, 16, 0, planes=7), {"render": 1.0, "tv": 1e-3}
    rest = fit(CanonicalStage(schedule, sizes, fine_loss=loss), data=data)
    group, across = rest.optimizer.param_groups[0], max(rest.scene_model.resolution[:2])
    assert rest.scene_model.resolution[2] == 7 < across
    # Total variation: by the planes along z, by the longer of the other sides along these.
    assert group["smoothing"] == pytest.approx(1e-3 * across / 128 / 16 / 6)
    assert group["smoothing"] * group["along_z"] == pytest.approx(1e-3 * 7 / 128 / 16 / 6)
    levels = DeformationSchedule([Level(4, 1), Level(8, 1)], rays=16, planes=6)
    moving = fit(DeformationStage(rest.result(), levels), data=data)
    assert moving.field.shape == moving.field.box.grid_shape(8**3, planes=6)
    assert (moving.field.shape[2], levels.grid(0)) == (6, (4**3, 3))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"alpha_init": 1.0}, r"field\.alpha_init: expected below 1, not 1\.0"),
        ({"search_alpha_init": 0.0}, r"field\.search_alpha_init: expected more than 0"),
        ({"width": 0}, r"field\.width: expected at least 1"),
        ({"planes": 1}, r"field\.planes: expected .*2"),
    ],
)
def test_sizes_of_no_field_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(DevrfError, match=said):
        Architecture(**settings)

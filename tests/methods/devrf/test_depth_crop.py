"""Depths at which a forward-facing scene shows nothing are given up."""

from __future__ import annotations

import pytest
import torch

from devrf.data.batch import all_pixels
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.methods.batch import gather_batch
from devrf.methods.devrf import depth_crop
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.color_decoder import SigmoidColor
from devrf.methods.devrf.depth_crop import (
    crop,
    crop_to_visible,
    visible_depths,
    with_room,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Scene

BOX = Box((-1.5, -1.0, -1.0), (1.5, 1.0, 1.0))


@pytest.fixture(scope="module")
def forward_scene() -> Scene:
    size = {"width": 24, "height": 18, "static_views": 7, "train_views": 2}
    return ProceduralForwardScene(**size, frames=2, supersample=1)()


def test_specks_and_fog_do_not_count():
    # 2000 rays that meet a wall at 0.6, one that meets a speck before it, and fog of 1 %.
    wall = torch.tensor([[-0.9, 0.6]]).repeat(2000, 1)
    weights = torch.tensor([[0.01, 0.99]]).repeat(2000, 1)
    wall[7], weights[7] = torch.tensor([-0.5, 0.6]), torch.tensor([0.9, 0.1])
    ray = torch.arange(2000).repeat_interleave(2)
    assert visible_depths(wall.flatten(), weights.flatten(), ray) == pytest.approx((0.6, 0.6))
    # A toy on 1 % of the rays counts, though less than the fog might be.
    wall[:20], weights[:20] = torch.tensor([0.2, 0.6]), torch.tensor([0.9, 0.1])
    assert visible_depths(wall.flatten(), weights.flatten(), ray) == pytest.approx((0.2, 0.6))


def test_while_all_is_fog_hardly_anything_is_given_up():
    depths = torch.linspace(-1, 1, 101).repeat(50)
    ends = visible_depths(
        depths, torch.full((5050,), 0.01), torch.arange(50).repeat_interleave(101)
    )
    assert ends == pytest.approx((-0.8, 0.8), abs=0.021)
    assert with_room(ends, BOX) == pytest.approx((-1.0, 0.88), abs=0.021)
    # A quarter of the depth that is seen before it, to move in, and a twentieth behind.
    assert with_room((0.2, 0.6), BOX) == pytest.approx((0.1, 0.62))


def test_a_cropped_field_is_the_same_where_it_still_is():
    field = CanonicalField(
        BOX, SigmoidColor(), channels=3, voxels=31 * 21 * 21, alpha_init=1e-2, planes=21
    )
    assert field.density.shape == (31, 20, 21)
    for grid in (field.density, field.color):
        torch.nn.init.normal_(grid.values)
    length, opacity = field.step_length(0.5), field.step_in_base_voxels(0.5)
    before = field.density.values[6:25, :, 10:, 0]
    kept = Box((-0.9, -1.0, 0.0), (0.9, 1.0, 1.0))
    crop(field, kept)
    assert field.box == kept and field.planes == 11
    assert field.density.shape == (18, 20, 11) and field.color.shape == (18, 20, 11)
    # Depths between planes are as they were, hence so is the way from sample to sample.
    assert field.step_length(0.5) == pytest.approx(length)
    assert field.step_in_base_voxels(0.5) == pytest.approx(opacity, rel=0.06)
    torch.testing.assert_close(field.density.values[0, :, :, 0], before[0])
    torch.testing.assert_close(field.density.values[-1, :, :, 0], before[-1])


def test_a_field_is_cropped_to_the_wall_that_it_shows(forward_scene):
    architecture = Architecture(channels=4, width=16, frequencies=0, planes=33)
    field = architecture.radiance_field(forward_scene.bounds.box, 20 * 15 * 33, 20 * 15 * 33)
    with torch.no_grad():
        field.density.values.fill_(-20)
        field.density.values[:, :, 24:28] = 20  # from z' = 0.5 to 0.6875
        field.color.values.normal_()
    views, occupancy = forward_scene.static.train, Occupancy.full(field.density.shape, field.box)
    settings = RenderSettings(step=0.5, alpha_threshold=1e-4, near=0.0, far=1.0)
    model = DeVRFModel(architecture, field, occupancy, settings, space=forward_scene.space)
    pool = all_pixels(views, torch.arange(len(views)))
    batch = gather_batch(
        views, pool.image[::9].long(), pool.flat[::9].long(), torch.zeros(3), model.space
    )
    before = model.at(0.0).render(batch.rays, batch.background)
    crop_to_visible(model, forward_scene, views, pool)
    # What is seen is the front of it; the field's front is by a twentieth of its depth before.
    assert 0.4 < field.box.low[2] < 0.5 and 0.5 < field.box.high[2] < 0.6
    assert field.density.values.numel() < 0.1 * 20 * 15 * 33
    after = model.at(0.0).render(batch.rays, batch.background)
    assert float(after.opacity.min()) > 1 - 1e-3
    torch.testing.assert_close(after.depth, before.depth, atol=0.02, rtol=0)


def test_a_field_that_has_become_empty_is_refused_when_it_grows(
    forward_scene, datamodule, trainer, monkeypatch
):
    class Emptied(CanonicalStage):
        def enter(self, phase):
            if self.phase is not None:
                self.scene_model.canonical.density.values.data.fill_(-60)
            super().enter(phase)

    monkeypatch.setattr(datamodule, "given", forward_scene)
    schedule = CanonicalSchedule(
        0, min_views=1, iterations=4, side=20, upsample_at=(2,), rays=64, crop=True
    )
    stage = Emptied(schedule, Architecture(channels=4, width=16, frequencies=0, planes=32))
    with pytest.raises(DevrfError, match="the field has become empty by iteration 2"):
        trainer(max_epochs=1).fit(stage, datamodule=datamodule)


def test_the_growing_grid_may_give_up_depths(forward_scene, datamodule, trainer, monkeypatch):
    asked, ends = [], iter([(-0.2, 0.6), (0.0, 0.6)])
    monkeypatch.setattr(
        depth_crop, "visible_depths", lambda *seen: asked.append(seen) or next(ends)
    )
    monkeypatch.setattr(datamodule, "given", forward_scene)
    schedule = CanonicalSchedule(
        0, min_views=1, iterations=6, side=20, upsample_at=(2, 4), rays=64, crop=True
    )
    stage = CanonicalStage(schedule, Architecture(channels=4, width=16, frequencies=0, planes=32))
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    field, whole = stage.scene_model.canonical, forward_scene.bounds.box
    assert len(asked) == 2
    # From a quarter of the depth that was seen last in front of it.
    assert (field.box.low[2], field.box.high[2]) == pytest.approx((-0.15, 0.63))
    # The voxels are as large as they would be in the whole box.
    uncropped = stage.architecture.radiance_field(whole, 8000, 8000)
    assert field.step_length(1.0) == pytest.approx(uncropped.step_length(1.0), rel=0.05)
    for axis in (0, 1):
        points = field.density.shape[axis] / uncropped.density.shape[axis]
        assert points == pytest.approx(field.box.size[axis] / whole.size[axis], abs=0.06)

"""DeVRF in contracted space: rays end in the field, and nothing moves outside the inner box."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from devrf.data.rendered import ProceduralDataModule
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.contraction import ContractedSpace
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.tracks import StartAlongFlow
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import VisitSettings
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.renderer import Renderer
from devrf.rendering.sampling import RenderSettings

SPACE = ContractedSpace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), shell=0.5)
BUILD = Architecture(channels=4, width=8, frequencies=1)


def test_displacements_are_zero_outside_where_they_are_asked_to_be():
    points = torch.tensor([[0.5, 0.0, 0.0], [1.0, 1.0, 1.0], [1.001, 0.0, 0.0], [0.0, 1.4, 0.0]])
    grid, box = torch.full((3, 3, 3, 3), 0.25), SPACE.inner()
    assert torch.equal(GridWarp(grid, box)(points), points + 0.25)
    still = GridWarp(grid, box, zero_outside_box=True)
    moved = still(points)
    torch.testing.assert_close(moved[:2], points[:2] + 0.25)
    assert torch.equal(moved[2:], points[2:])


def test_a_field_knows_that_what_is_outside_stays():
    clock = FrameClock((0.0, 1.0))
    field = DeformationField(SPACE.inner(), clock, voxels=27, zero_outside_box=True)
    field.backward_slices[1:] = 0.25
    outside = torch.tensor([[1.3, 0.0, 0.0]])
    assert torch.equal(field.backward_warp(1.0)(outside), outside)
    again = DeformationField(Box((0.0,) * 3, (1.0,) * 3), clock, voxels=8)
    again.set_extra_state(field.get_extra_state())
    assert again.zero_outside_box and again.box == SPACE.inner()


@pytest.fixture
def model() -> DeVRFModel:
    """Random colours around a ball that moves along x; far away the field is empty."""
    torch.manual_seed(0)
    canonical = BUILD.radiance_field(SPACE.box, 18**3, 18**3)
    points = SPACE.box.grid_points(canonical.density.shape, torch.empty(0))
    solid = points.norm(dim=-1) < 0.5
    with torch.no_grad():
        canonical.density.values.fill_(-9.0)
        canonical.density.values[solid] = 12.0
        canonical.color.values.copy_(torch.randn(*canonical.color.shape, 4))
    deformation = DeformationField(
        SPACE.inner(), FrameClock((0.0, 0.5, 1.0)), voxels=8**3, zero_outside_box=True
    )
    deformation.backward_slices[1, ..., 0], deformation.backward_slices[2, ..., 0] = -0.1, -0.2
    settings = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.2, far=math.inf)
    return DeVRFModel(BUILD, canonical, Occupancy(solid, SPACE.box), settings, deformation, SPACE)


def _views(count: int = 60) -> Rays:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(3))
    directions = torch.nn.functional.normalize(directions, dim=1)
    return Rays(torch.tensor([[-2.0, 0.0, 0.0]]).expand(count, 3), directions, directions)


def test_rays_that_meet_nothing_end_in_the_fields_colour_at_infinity(model):
    rays = _views()
    seen = Renderer(model).picture(rays, 0.0, 1.0)
    missed = seen.opacity < 1e-6
    assert 10 < int(missed.sum()) < 60
    ends = SPACE.rays(rays).ends()
    with torch.no_grad():
        expected = model.canonical.rgb(ends, rays.viewdirs, torch.arange(len(rays)))
    torch.testing.assert_close(seen.color[missed], expected[missed])
    # The given background shows nowhere.
    torch.testing.assert_close(Renderer(model).picture(rays, 0.0, 0.0).color, seen.color)


def test_a_checkpoint_keeps_the_outer_faces(model):
    other = DeVRFModel.from_config(model.config())
    other.load_stored_state(model.stored_state())
    assert other.space == SPACE and other.deformation is not None
    ours, theirs = (Renderer(each).picture(_views(), 0.75, 1.0) for each in (model, other))
    # Grids are stored in half precision.
    torch.testing.assert_close(ours.color, theirs.color, atol=5e-3, rtol=0)


def test_in_contracted_space_grids_start_coarse_and_directions_come_late():
    # 50 · 1.2 = 60 voxels a side from 15: six doublings, over 600 of 800 iterations.
    schedule = CanonicalSchedule(
        5, side=50, iterations=800, upsample_at=(10,), unbounded_initial_side=15
    )
    fitted = schedule.in_space(SPACE)
    assert fitted.upsample_at == (100, 200, 300, 400, 500, 600)
    # There is no search: what it would find is where fog explains the images.
    assert fitted.phases[0].kind == "fine"
    assert fitted.phases[0].voxels == pytest.approx(15**3, rel=1e-3)
    assert [fitted.learns_directions(n) for n in (0, 399, 400)] == [False, False, True]
    given = replace(schedule, unbounded_initial_side=None, view_dependence_start=0).in_space(SPACE)
    assert given.upsample_at == (10,) and given.learns_directions(5)
    assert schedule.in_space(WORLD) is schedule


def test_the_fields_opacity_does_not_depend_on_its_resolution():
    sizes = Architecture(alpha_init=0.01, contracted_opacity=0.75)
    assert sizes.in_space(WORLD, 2.0) is sizes
    # A line through two voxels, of opacity a half each: 1 − ¼.
    field = sizes.in_space(SPACE, 2.0).radiance_field(SPACE.box, 27, 27)
    torch.testing.assert_close(field.voxel_alpha(1.0), torch.full((3, 3, 3), 0.5))
    assert sizes.in_space(SPACE, 4.0).alpha_init == pytest.approx(1 - 0.25**0.25)


def test_a_room_is_learned_and_moves_inside_the_inner_box(tiny_room, trainer):
    room, data = tiny_room, ProceduralDataModule(recipe=lambda: lambda: tiny_room)
    schedule = CanonicalSchedule(
        search_iterations=0,
        search_side=16,
        visual_hull_init=True,
        iterations=60,
        side=16,
        upsample_at=(20,),
        rays=128,
    )
    stage = CanonicalStage(schedule, BUILD)
    trainer(max_epochs=1, log_every_n_steps=1).fit(stage, datamodule=data)
    assert stage.scene_model.box == room.bounds.box and stage.schedule.side == pytest.approx(25.6)
    # Behind the walls nothing has been seen, and nothing is kept there.
    assert not stage.scene_model.occupancy.at(torch.tensor([room.bounds.box.high])).any()
    # Directions came in at iteration 30: colours have begun to depend on them, little so far.
    decoder = stage.scene_model.canonical.decoder
    assert isinstance(decoder, ColorDecoder) and decoder.learns_directions
    weight = decoder.from_direction.weight
    assert 0 < float(weight.detach().abs().max()) < 0.1
    mean = room.static.train.pixels.float().div(255).mean(dim=(0, 1, 2))
    blank = float((room.static.train.pixels.float() / 255 - mean).square().mean())
    metrics = stage.trainer.callback_metrics
    assert metrics["static/render"] < 0.9 * blank and metrics["static/distortion"] > 0
    moving = DeformationStage(
        stage.result(),
        DeformationSchedule(levels=(Level(6, 4),), rays=64),
        VisitSettings(unit="box", views="all"),
        extensions={"tracks": StartAlongFlow("flow")},
    )
    trainer(max_epochs=1).fit(moving, datamodule=data)
    assert moving.field.box == room.space.inner(room.bounds.box) and moving.field.zero_outside_box
    far = torch.tensor([[room.bounds.box.high[0], 0.0, 0.0]])
    assert torch.equal(moving.scene_model.deformation.backward_warp(1.0)(far), far)
    assert bool(moving.field.backward_slices[1].any())

"""A whole scene model: which time is seen, where matter is then, and what exports ask for."""

from __future__ import annotations

import math

import pytest
import torch

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.geometry.ndc import NormalizedDevice
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.volume_rendering import deformed_occupancy, possible_occupancy
from devrf.rendering.occupancy import Occupancy, dilate
from devrf.rendering.output import RenderedImage
from devrf.rendering.renderer import Renderer
from devrf.rendering.sampling import RenderSettings

SIDE = 11
SETTINGS = RenderSettings(step=0.5, alpha_threshold=1e-3, near=0.0, far=9.0)


@pytest.fixture
def model(cube: Box) -> DeVRFModel:
    """A red ball-like block in the middle that moves by +0.4 along x until t = 1."""
    mask = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    mask[5:7, 4:7, 4:7] = True
    build = Architecture()
    canonical = build.search_field(cube, SIDE**3)
    with torch.no_grad():
        canonical.density.values[mask] = 40.0
        canonical.color.values.copy_(torch.tensor([9.0, -9.0, -9.0]).expand(11, 11, 11, 3))
    deformation = DeformationField(cube, FrameClock((0.0, 0.5, 1.0)), voxels=27)
    for frame, way in ((1, 0.2), (2, 0.4)):
        deformation.backward_slices[frame, ..., 0] = -way
        deformation.forward_slices[frame, ..., 0] = way
    return DeVRFModel(build, canonical, Occupancy(dilate(mask, 1), cube), SETTINGS, deformation)


def looking_down(count: int) -> Rays:
    """``count`` rays along −z at x from −0.95 to 0.95."""
    x = torch.linspace(-0.95, 0.95, count)
    origins = torch.stack([x, 0.02 + 0 * x, 3 + 0 * x], dim=1)
    d = torch.tensor([[0.0, 0.0, -1.0]]).expand(count, 3)
    return Rays(origins, d, d)


def picture(model: DeVRFModel, rays: Rays, time: float, background: float = 1.0) -> RenderedImage:
    return Renderer(model).picture(rays, time, background)


def middle(model: DeVRFModel, time: float) -> float:
    """Where along x the block is seen at ``time``."""
    rays = looking_down(191)
    opacity = picture(model, rays, time, 0.0).opacity
    assert 20 < float(opacity.sum()) < 60
    return float((rays.origins[:, 0] * opacity).sum() / opacity.sum())


@pytest.mark.parametrize(("time", "way"), [(0.5, 0.2), (0.8, 0.32)])
def test_the_block_is_seen_where_it_has_moved(model, time, way):
    # 0.8 lies between frames: seen times in between move evenly.
    assert middle(model, time) - middle(model, 0.0) == pytest.approx(way, abs=0.02)


def test_at_rest_nothing_is_warped(model):
    assert model.backward_warp(0.0).displacement is None
    assert model.occupancy_at(0.0) is model.occupancy
    moving, model.deformation = picture(model, looking_down(31), 0.0), None
    still = picture(model, looking_down(31), 0.7)
    assert torch.equal(moving.color, still.color) and torch.equal(moving.depth, still.depth)


def moved_by(model: DeVRFModel, shift: torch.Tensor) -> GridWarp:
    """x → x + ``shift`` (3,)."""
    return GridWarp(shift.expand(2, 2, 2, 3).contiguous(), model.box)


def test_deformed_occupancy_by_hand(model):
    shift = torch.tensor([0.0, 0.4, 0.0])
    warp = moved_by(model, shift)
    found = deformed_occupancy(model.canonical, model.occupancy, model.settings, warp)
    opaque = model.canonical.voxel_alpha(model.settings.step) >= model.settings.alpha_threshold
    moved = torch.roll(opaque & model.occupancy.mask, -2, dims=1)
    assert torch.equal(found.mask, dilate(moved, 1))
    assert found.box == model.canonical.box


def test_while_a_frame_is_learned_all_that_may_be_is_occupied(model):
    shift = torch.tensor([0.0, 0.4, 0.0])
    warp = moved_by(model, shift)
    found = possible_occupancy(model.occupancy, warp)
    assert torch.equal(found.mask, dilate(torch.roll(model.occupancy.mask, -2, dims=1), 1))


def test_points_that_move_nowhere_are_not_occupied(model):
    lost = moved_by(model, torch.full((3,), math.nan))
    found = deformed_occupancy(model.canonical, model.occupancy, model.settings, lost)
    assert not found.mask.any() and not possible_occupancy(model.occupancy, lost).mask.any()


def test_a_thin_thing_is_not_lost_between_the_places_that_points_come_from(model):
    field = model.canonical
    field.density.values.data.fill_(-50.0)
    x, y, z = (n // 2 for n in field.density.shape)
    field.density.values.data[x, y, z] = 20.0
    model.occupancy.mask.fill_(True)
    cell = [edge / (n - 1) for edge, n in zip(field.box.size, field.density.shape, strict=True)]
    half = 0.49 * torch.tensor(cell)  # none of the points comes from where it is opaque
    found = deformed_occupancy(field, model.occupancy, model.settings, moved_by(model, half))
    expected = torch.zeros_like(found.mask)
    expected[x - 1 : x + 2, y - 1 : y + 2, z - 1 : z + 2] = True
    assert torch.equal(found.mask, expected)


@pytest.mark.parametrize("space", [WORLD, NormalizedDevice(8, 6, (40.0, 40.0), near=2.0)])
def test_a_model_built_from_its_config_takes_its_state(model, space):
    model.space = space
    other = DeVRFModel.from_config(model.config())
    other.load_stored_state(model.state_dict())
    assert other.config() == model.config() and other.size == model.size
    assert other.moves and other.box == model.box and other.space == space
    rays = looking_down(31)
    for time in (0.0, 0.8):
        assert torch.equal(picture(other, rays, time).color, picture(model, rays, time).color)


def test_loaded_displacements_stay_in_half_precision_and_are_read_in_single(model):
    other = DeVRFModel.from_config(model.config())
    other.load_stored_state(model.stored_state())
    for frames in (other.deformation.backward_slices, other.deformation.forward_slices):
        assert frames.dtype == torch.float16
    points = torch.full((1, 3), 0.1)
    for time in (0.25, 0.6):  # at a frame, and between two
        assert other.deformation.backward_warp(time).displacement.dtype == torch.float32
        before, after = (
            model.deformation.backward_warp(time)(points),
            other.deformation.backward_warp(time)(points),
        )
        torch.testing.assert_close(after, before, atol=1e-3, rtol=0)


def test_a_voxel_has_the_initial_opacity_where_something_may_be(cube):
    mask = torch.zeros(5, 5, 5, dtype=torch.bool)
    mask[0] = True
    build = Architecture()
    model = DeVRFModel(build, build.search_field(cube, 5**3), Occupancy(mask, cube), SETTINGS)
    field = model.surface()
    assert (field.box, field.shape) == (cube, (5, 5, 5))
    depth = field.optical_depth(torch.tensor([[-1.0, 0.3, 0.0], [1.0, 0.3, 0.0]]))
    # A raw density of 0 gives a voxel 10⁻⁶.
    assert -math.expm1(-float(depth[0])) == pytest.approx(1e-6, rel=1e-2)
    assert depth[1] == 0
    # Without motion every point stays.
    assert torch.equal(model.forward_warp(0.7)(depth[:, None]), depth[:, None])


def test_points_go_where_the_forward_displacements_lead(model):
    points = torch.tensor([[0.1, 0.2, 0.3]])
    assert torch.equal(model.forward_warp(0.0)(points), points)
    moved = model.forward_warp(0.25)(points)
    torch.testing.assert_close(moved, torch.tensor([[0.2, 0.2, 0.3]]))
    assert not moved.requires_grad


def test_a_finished_checkpoint_is_small_and_shows_the_same(model):
    stored = model.stored_state()
    after = DeVRFModel.from_config(model.config())
    after.load_stored_state(stored)
    for time in (0.5, 0.8):  # at a frame, and between two
        seen, expected = (picture(each, looking_down(191), time) for each in (after, model))
        torch.testing.assert_close(seen.color, expected.color, atol=5e-3, rtol=0)
        # Where the block was at rest, and between its places, points must not lead back to it.
        occupied, truth = after.occupancy_at(time).mask, model.occupancy_at(time).mask
        assert not (occupied & ~dilate(truth, 1)).any()
    packed = stored["canonical.color.values"]
    assert sum(v.nbytes for v in packed.values() if torch.is_tensor(v)) < (
        0.3 * model.canonical.color.values.nbytes
    )


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_grids_are_packed_and_unpacked_alike_on_a_gpu(model):
    stored, device = model.stored_state(), torch.device("cuda", 0)
    there = DeVRFModel.from_config(model.config()).to(device)
    there.load_stored_state(stored)
    again, here = there.stored_state(), DeVRFModel.from_config(model.config())
    here.load_stored_state(stored)
    for name, value in here.state_dict().items():
        if torch.is_tensor(value):
            found = there.state_dict()[name]
            assert found.is_cuda and found.dtype == value.dtype
            torch.testing.assert_close(found.cpu(), value, atol=1e-3, rtol=1e-3)
    for name, value in stored.items():
        if isinstance(value, dict) and "kept" in value:
            assert torch.equal(again[name]["keep"], value["keep"])


def test_what_half_precision_cannot_hold_stays_as_it_is(model):
    with torch.no_grad():
        model.canonical.density.values[5, 5, 5] = 1e5
    after = DeVRFModel.from_config(model.config())
    after.load_stored_state(model.stored_state())
    assert torch.equal(after.canonical.density.values, model.canonical.density.values)

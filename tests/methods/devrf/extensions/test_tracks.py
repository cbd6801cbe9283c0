"""Tracks along the flow: followed back in a scene of three bands, and fitted by a frame."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.data.batch import PixelPool
from devrf.data.flow import previous_images
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level, Visits
from devrf.methods.devrf.extensions.tracks import (
    FlowTracks,
    StartAlongFlow,
    Tracks,
    start_from_tracks,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sampling import RenderSettings
from devrf.scenes.scene import OpticalFlow, Views

SIDE, WIDTH, HEIGHT = 21, 30, 10
RED, GREEN, BLUE, BLACK = (255, 0, 0), (0, 255, 0), (0, 0, 255), (0, 0, 0)
# The middles of the bands, in pixels along x: 4 units away, 10 pixels are 2/3 of a unit.
LEFT, MIDDLE, RIGHT = 5, 15, 25
ROW = HEIGHT // 2


@pytest.fixture
def model(cube: Box) -> DeVRFModel:
    """An opaque sheet at z = 0: red to x = −1/3, green, and blue from 1/3 on; nothing moves."""
    build = Architecture()
    canonical = build.search_field(cube, SIDE**3)
    mask = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    mask[:, :, 10] = True
    with torch.no_grad():
        canonical.density.values[mask] = 40.0
        for band, color in enumerate((RED, GREEN, BLUE)):
            logits = torch.tensor(color) / 255 * 18 - 9
            canonical.color.values[7 * band : 7 * band + 7] = logits
    settings = RenderSettings(step=0.25, alpha_threshold=1e-3, near=0.0, far=9.0)
    deformation = DeformationField(cube, FrameClock((0.0, 1 / 3, 2 / 3, 1.0)), voxels=27)
    return DeVRFModel(build, canonical, Occupancy(mask, cube), settings, deformation)


@pytest.fixture
def views() -> Views:
    """Four frames of a camera above the sheet; flow is zero and valid from frame 1 on."""
    above = torch.tensor([[0.0, 0.0, 4.0]]).expand(4, 3)
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = Cameras.looking_at(
        above, torch.zeros(4, 3), focal=60.0, width=WIDTH, height=HEIGHT, up=up
    )
    valid = torch.ones(4, HEIGHT, WIDTH, dtype=torch.bool)
    valid[0] = False
    return Views(
        pixels=torch.zeros(4, HEIGHT, WIDTH, 3, dtype=torch.uint8),
        cameras=cameras,
        times=torch.arange(4) / 3,
        view=torch.zeros(4, dtype=torch.long),
        names=("a", "b", "c", "d"),
        flow=OpticalFlow(torch.zeros(4, HEIGHT, WIDTH, 2), valid),
        frames=torch.arange(4),
    )


def leads(views: Views, frame: int, column: int, to: int) -> None:
    """Let the flow of the row's pixel at ``column`` of a frame lead to column ``to``."""
    assert views.flow is not None
    views.flow.vectors[frame, ROW, column, 0] = to - column


def followed(model: DeVRFModel, views: Views, *columns: int, by_color: bool, **kw: int) -> Tracks:
    """The tracks of the row's pixels at ``columns`` of frame 3."""
    flat = torch.tensor([ROW * WIDTH + column for column in columns], dtype=torch.int32)
    pool = PixelPool(torch.stack([torch.full_like(flat, 3), flat]))
    tracks = FlowTracks(model, views, previous_images(views), by_color=by_color)
    return tracks.follow(3, pool, torch.Generator().manual_seed(0), **kw)


def x_of(column: float) -> float:
    """Where on the sheet a column's middle looks at."""
    return (column + 0.5 - WIDTH / 2) * 4 / 60


def test_a_pixel_ends_where_its_color_is_met(model, views):
    # A red pixel: one frame back the flow meets the blue band, two frames back the red one.
    views.pixels[3, ROW, MIDDLE] = torch.tensor(RED)
    leads(views, 3, MIDDLE, RIGHT)
    leads(views, 2, RIGHT, LEFT)
    met = followed(model, views, MIDDLE, by_color=True)
    assert met.canonical[:, :2].flatten().tolist() == pytest.approx(
        [x_of(LEFT), (HEIGHT / 2 - ROW - 0.5) * 4 / 60], abs=0.02
    )
    assert met.camera.tolist() == [3]
    assert met.pixel.tolist() == [[MIDDLE + 0.5, ROW + 0.5]]
    nearest = followed(model, views, MIDDLE, by_color=False)
    assert nearest.canonical[:, 0].tolist() == pytest.approx([x_of(RIGHT)], abs=0.02)


def test_what_is_met_nowhere_or_cannot_be_followed_is_no_track(model, views):
    assert views.flow is not None
    # Black is nowhere; the flow of the second ends, the third leaves the image, the fourth is met.
    for column, color in ((2, BLACK), (12, RED), (14, BLUE), (MIDDLE, GREEN)):
        views.pixels[3, ROW, column] = torch.tensor(color)
    views.flow.valid[2, ROW, 12] = False
    leads(views, 3, 14, -7)
    met = followed(model, views, 2, 12, 14, MIDDLE, by_color=True)
    assert met.pixel[:, 0].tolist() == [MIDDLE + 0.5]


def test_points_are_those_that_had_moved_there(model, views):
    # In frame 2 the whole sheet lies 0.2 further to the right.
    assert model.deformation is not None
    model.deformation.backward_slices[2, ..., 0] = -0.2
    met = followed(model, views, MIDDLE, by_color=False)
    assert met.canonical[:, 0].tolist() == pytest.approx([x_of(MIDDLE) - 0.2], abs=0.02)


BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
SHIFT = torch.tensor([0.3, -0.2, 0.1])


def three_cameras() -> Cameras:
    positions = torch.tensor([[4.0, 0.0, 1.0], [0.0, 4.0, 1.0], [-3.0, -2.5, 1.5]])
    return Cameras.looking_at(positions, torch.zeros(3, 3), focal=120.0, width=100, height=80)


def shifted_ball(cameras: Cameras, radius: float = 0.4, count: int = 900) -> Tracks:
    """Points of a ball at rest, each seen by one camera once the ball has moved by SHIFT."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    points = radius * torch.nn.functional.normalize(points, dim=1)
    camera = torch.arange(count) % len(cameras)
    pixel, _ = cameras.project(camera, points + SHIFT)
    return Tracks(points, camera, pixel)


def test_three_views_of_a_shift_give_the_shift_and_the_way_back():
    field = DeformationField(BOX, FrameClock((0.0, 0.5, 1.0)), voxels=10**3)
    cameras = three_cameras()
    tracks = shifted_ball(cameras)
    tracks.pixel[::50] += 40.0  # the wrong flow of a few pixels is outvoted
    start_from_tracks(field, 2, tracks, cameras)
    moved = field.forward_warp(1.0)(tracks.canonical)
    # The shift is more than the ball's radius: no rendered overlap could have shown it.
    assert (moved - tracks.canonical - SHIFT).norm(dim=1).median() < 0.02
    assert not field.backward_slices[:2].any() and not field.forward_slices[:2].any()
    back = field.backward_warp(1.0)(tracks.canonical + SHIFT)
    assert (back - tracks.canonical).norm(dim=1).median() < 0.03


def test_without_tracks_the_frame_stays_where_the_one_before_is():
    field = DeformationField(BOX, FrameClock((0.0, 0.5, 1.0)), voxels=4**3)
    field.backward_slices[1] = 0.25
    field.frames.copy_previous(2)
    nothing = Tracks(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2))
    start_from_tracks(field, 2, nothing, three_cameras())
    assert torch.equal(field.backward_slices[2], field.backward_slices[1])


def test_flow_starts_the_frames_of_the_first_level(tiny_scene):
    schedule = DeformationSchedule((Level(5, 4), Level(6, 4)))
    phases = [Visits(schedule, 4).phase(at) for at in (0, 8, 16)]
    assert [(phase.level, phase.frame) for phase in phases] == [(0, 1), (0, 2), (1, 1)]
    context: Any = SimpleNamespace(views=tiny_scene.dynamic.train)
    assert [StartAlongFlow("flow").changes(context, phase) for phase in phases] == [
        True,
        True,
        False,
    ]
    assert not any(StartAlongFlow("previous").changes(context, phase) for phase in phases)


def test_a_misspelt_start_is_refused():
    with pytest.raises(DevrfError, match="tracks.init_from: expected previous, flow or tracks"):
        StartAlongFlow("trakcs")

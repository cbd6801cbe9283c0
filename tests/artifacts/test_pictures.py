"""Colour maps, contact sheets and films, read back from the files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from torch import Tensor

from devrf.artifacts.camera_paths import orbit
from devrf.artifacts.colors import (
    UNKNOWN,
    depth_colors,
    error_colors,
    flow_colors,
    flow_wheel,
    to_bytes,
)
from devrf.artifacts.contact_sheet import write_contact_sheet
from devrf.artifacts.film import WATCHABLE, FilmSettings, film_bytes, pictures, write_video
from devrf.artifacts.images import GAP, evenly, short_name
from devrf.evaluation.held_out import HeldOutView
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.rendering.renderer import Renderer


def flat(height: int, width: int, color: tuple[float, float, float]) -> Tensor:
    return torch.tensor(color).expand(height, width, 3)


def test_bytes_are_rounded_and_clamped() -> None:
    values = torch.tensor([-1.0, 0.0, 0.5, 1.0, 7.0, 0.9985])
    assert to_bytes(values).tolist() == [0, 0, 128, 255, 255, 255]


def test_depth_is_bright_near_dark_far_and_white_where_nothing_is() -> None:
    depth = torch.tensor([[1.0, 1.5, 2.0, 3.0, 0.0]])
    opacity = torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]])
    light = depth_colors(depth, opacity, near=1.0, far=2.0)[0].mean(dim=1)
    assert light[4] == 1 > light[0] > light[1] > light[2] == light[3]


def test_errors_are_black_to_white_up_to_a_quarter() -> None:
    prediction = torch.tensor([0.0, 0.1, 0.25, 0.9])[None, :, None].expand(1, 4, 3)
    light = error_colors(prediction, torch.zeros(1, 4, 3)).mean(dim=-1)[0]
    assert light[0] < 0.05 < light[1] < 0.95 < light[2] == light[3]


def test_flow_as_colours() -> None:
    vectors = torch.tensor([[[2.0, 0.0], [0.0, -2.0], [-9.0, 0.0], [0.0, 0.0], [7.0, 7.0]]])
    valid = torch.tensor([[True, True, True, True, False]])
    expected = torch.tensor(
        [
            [0.9, 0.0, 0.0],  # to the right: red
            [0.45, 0.9, 0.0],  # up: a quarter turn further
            [0.0, 0.9, 0.9],  # to the left, as saturated as it gets
            [1.0, 1.0, 1.0],  # nowhere
            [UNKNOWN] * 3,
        ]
    )
    colors = flow_colors(vectors, valid, full=2.0)
    torch.testing.assert_close(colors[0], expected, atol=1e-5, rtol=0)


def test_the_wheel_shows_the_directions_that_it_explains() -> None:
    wheel = flow_wheel(101)
    assert torch.equal(wheel[0, 0], torch.ones(3))
    red, cyan = wheel[50, 99], wheel[50, 1]
    assert red[0] > 0.85 > 0.1 > red[1] and cyan[0] < 0.1 < 0.85 < cyan[1]
    torch.testing.assert_close(wheel[50, 50], torch.ones(3), atol=0.02, rtol=0)


def view(number: int, height: int = 90, width: int = 120) -> HeldOutView:
    truth = flat(height, width, (0.0, 0.0, 1.0))
    prediction = flat(height, width, (number / 255, 0.0, 0.0))
    return HeldOutView(f"{number}", 0.0, truth, prediction, 10.0, 0.5, 9.0, compared=prediction)


@pytest.mark.parametrize(("count", "shades"), [(11, [0, 50, 100]), (2, [0, 10]), (1, [0])])
def test_a_contact_sheet_shows_prediction_truth_and_error_of_spread_views(
    tmp_path: Path, count: int, shades: list[int]
) -> None:
    path = tmp_path / "images" / "static.png"
    shown = write_contact_sheet(path, [view(10 * k) for k in range(count)], rows=3)
    sheet = iio.imread(path)
    assert torch.equal(torch.from_numpy(sheet), to_bytes(shown))
    # Images are enlarged twice, to 240 pixels; labels 30 pixels high stand above and below.
    assert sheet.shape == (30 + len(shades) * (180 + 30), 3 * 240 + 2 * GAP, 3)
    for row, shade in enumerate(shades):
        top = 30 + row * 210
        assert (sheet[top : top + 180, :240] == [shade, 0, 0]).all()
        assert (sheet[top : top + 180, 240 : 240 + GAP] == 255).all()
        assert (sheet[top : top + 180, 240 + GAP : 480 + GAP] == [0, 0, 255]).all()
        for column in range(3):
            label = sheet[top + 180 : top + 210, column * 242 : (column + 1) * 242]
            assert label.min() < 50 and label.max() == 255


def test_names_and_positions() -> None:
    assert evenly(3, 6) == [0, 1, 2]
    assert evenly(50, 6) == [0, 10, 20, 29, 39, 49]
    assert short_name("folder/r_000.png") == "r_000.png"
    assert short_name(30 * "a" + "_000.png") == "…" + 21 * "a" + "_000.png"


@pytest.mark.parametrize(("height", "width"), [(48, 96), (241, 33), (15, 7), (301, 300)])
def test_a_video_has_even_sides_a_watchable_size_and_all_its_pictures(
    tmp_path: Path, height: int, width: int
) -> None:
    path = tmp_path / "videos" / "orbit.mp4"
    shades = (0.0, 0.5, 1.0, 0.25)
    write_video(path, iter([flat(height, width, (s, s, s)) for s in shades]), fps=10)
    frames = iio.imread(path, plugin="FFMPEG")
    factor = max(1, math.ceil(240 / height))
    expected = (factor * height + factor * height % 2, factor * width + factor * width % 2)
    assert frames.shape == (4, *expected, 3)
    assert expected[0] >= 240
    for frame, shade in zip(frames, shades, strict=True):
        assert abs(float(frame.mean()) - 255 * shade) < 4
    assert [p.name for p in path.parent.iterdir()] == ["orbit.mp4"]


def test_a_film_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    def broken() -> Iterator[Tensor]:
        yield flat(240, 240, (0, 0, 0))
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        write_video(tmp_path / "film.mp4", broken(), fps=10)
    assert list(tmp_path.iterdir()) == []


def ring(count: int) -> Cameras:
    angle = torch.arange(count) * (2 * math.pi / count)
    positions = torch.stack([3 * angle.cos(), 3 * angle.sin(), 0 * angle + 1], dim=1)
    return Cameras.looking_at(positions, torch.zeros(count, 3), focal=20.0, width=15, height=10)


def test_an_orbit_circles_the_box_at_the_cameras_distance(cube: Box) -> None:
    settings = FilmSettings(frames=8, orbit_turns=2.0, orbit_elevation=30.0)
    cameras = orbit(ring(6), cube, settings)
    assert len(cameras) == 8 and (cameras.width, cameras.height) == (15, 10)
    torch.testing.assert_close(cameras.positions.norm(dim=1), torch.full((8,), math.sqrt(10)))
    torch.testing.assert_close(cameras.positions[:, 2], torch.full((8,), math.sqrt(10) / 2))
    # Two turns in eight pictures: a quarter turn each.
    steps = cameras.positions[:-1, :2] * cameras.positions[1:, :2]
    torch.testing.assert_close(steps.sum(dim=1), torch.zeros(7), atol=1e-5, rtol=0)
    toward = torch.nn.functional.normalize(-cameras.positions, dim=1)
    torch.testing.assert_close(cameras.forwards, toward)


def test_pictures_show_colour_beside_depth_while_time_runs(moving, reference) -> None:
    camera = ring(1)
    shown = list(pictures(Renderer(moving), camera[[0, 0, 0]], 1.0))
    assert [tuple(image.shape) for image in shown] == [(10, 30, 3)] * 3
    for image, time in zip(shown, (0.0, 0.5, 1.0), strict=True):
        seen = reference(moving, camera.image_rays(0), time, torch.ones(3))
        torch.testing.assert_close(image[:, :15].reshape(-1, 3), seen.color, atol=1e-5, rtol=0)


def test_a_video_is_no_larger_than_was_said(rest, tiny_scene, tmp_path):
    cameras = tiny_scene.static.train.cameras
    for height in (None, 40):
        film = FilmSettings(frames=8, height=height)
        turned = orbit(cameras, rest.model.canonical.box, film)
        path = tmp_path / "orbit.mp4"
        shown = pictures(Renderer(rest.model), turned, 1.0)
        write_video(path, shown, film.fps, least=WATCHABLE if height is None else 0)
        assert 0.02 * film_bytes(film, cameras) < path.stat().st_size < film_bytes(film, cameras)

"""Colour maps, stills, contact sheets and videos, read back from the files."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.apps.still import StillSettings, sized, still
from devrf.apps.video import (
    VideoSettings,
    held_out_images,
    held_out_pictures,
    held_out_times,
    path_pictures,
)
from devrf.checkpoints.checkpoint import Viewpoints
from devrf.errors import DevrfError
from devrf.evaluation.held_out import HeldOutView, score, truth_image
from devrf.pictures.held_out import write_contact_sheet
from devrf.pictures.images import (
    UNKNOWN,
    depth_colors,
    evenly,
    flow_colors,
    scaled,
    short_name,
    to_bytes,
)
from devrf.pictures.video_file import write_pictures
from devrf.rendering.renderer import Renderer
from pictures import plain_picture


def flat(height, width, color):
    return torch.tensor(color).expand(height, width, 3)


def test_depth_is_bright_near_dark_far_and_white_where_nothing_is():
    depth = torch.tensor([[1.0, 1.5, 2.0, 3.0, 0.0]])
    opacity = torch.tensor([[1.0, 1.0, 1.0, 1.0, 0.0]])
    light = depth_colors(depth, opacity, near=1.0, far=2.0)[0].mean(dim=1)
    assert light[4] == 1 > light[0] > light[1] > light[2] == light[3]


def test_flow_as_colours():
    vectors = torch.tensor([[[2.0, 0.0], [0.0, -2.0], [-9.0, 0.0], [0.0, 0.0], [7.0, 7.0]]])
    valid = torch.tensor([[True, True, True, True, False]])
    red, green, cyan = [0.9, 0.0, 0.0], [0.45, 0.9, 0.0], [0.0, 0.9, 0.9]
    # To the right, up a quarter turn further, to the left as saturated as it gets, nowhere.
    expected = torch.tensor([red, green, cyan, [1.0] * 3, [UNKNOWN] * 3])
    colors = flow_colors(vectors, valid, full=2.0)
    torch.testing.assert_close(colors[0], expected, atol=1e-5, rtol=0)


def view(number, height=90, width=120):
    truth = flat(height, width, (0.0, 0.0, 1.0))
    prediction = flat(height, width, (number / 255, 0.0, 0.0))
    depth, opacity = torch.full((height, width), 2.0 + number), torch.ones(height, width)
    seen = {"compared": prediction, "depth": depth, "opacity": opacity}
    return HeldOutView(f"frame {number}", 0.25, truth, prediction, 10.0, 0.5, 9.0, **seen)


def test_a_contact_sheet_shows_truth_rendering_error_and_depth_of_spread_views(tmp_path):
    path, shades = tmp_path / "images" / "static.png", [0, 50, 100]
    shown = write_contact_sheet(path, [view(10 * k) for k in range(11)], rows=3)
    sheet = iio.imread(path)
    assert torch.equal(torch.from_numpy(sheet), shown)
    # Images are enlarged to 300 x 400 pixels, text is 15 pixels high, and 6 are between images.
    left = sheet.shape[1] - 4 * 400 - 3 * 6
    assert sheet.shape[0] == 30 + len(shades) * (300 + 6) - 6 and left > 80
    depths = []
    for row, shade in enumerate(shades):
        top = 30 + row * 306
        truth, rendered, error, depth = (
            sheet[top : top + 300, left + k * 406 : left + k * 406 + 400] for k in range(4)
        )
        assert (truth == [0, 0, 255]).all() and (rendered == [shade, 0, 0]).all()
        assert (error == error[0, 0]).all() and error.max() == 255
        depths.append(int(depth[0, 0].sum()))
        assert dark(sheet[top : top + 300, :left])
    # The nearest is the brightest.
    assert depths == sorted(depths, reverse=True) and len(set(depths)) == len(depths)
    assert dark(sheet[:30, left : left + 400])


def dark(area):
    """Whether there is text, with a margin of white all around."""
    ink = area.max(axis=-1) < 128
    return bool(ink.any()) and not (ink[0].any() or ink[-1].any() or ink[:, [0, -1]].any())


def test_names_and_positions():
    assert evenly(3, 6) == [0, 1, 2]
    assert evenly(50, 6) == [0, 10, 20, 29, 39, 49]
    assert short_name("folder/r_000.png") == "r_000.png"
    assert short_name(30 * "a" + "_000.png") == "…" + 21 * "a" + "_000.png"


def test_a_video_has_even_sides_and_all_its_pictures(tmp_path):
    path = tmp_path / "videos" / "orbit.mp4"
    shades = (0, 128, 255, 64)
    write_pictures(path, iter([np.full((17, 75, 3), s, np.uint8) for s in shades]), fps=7.5)
    frames = iio.imread(path, plugin="FFMPEG")
    assert frames.shape == (4, 18, 76, 3)
    for frame, shade in zip(frames, shades, strict=True):
        assert abs(float(frame.mean()) - shade) < 4
    assert iio.immeta(path, plugin="FFMPEG")["fps"] == 7.5
    assert [p.name for p in path.parent.iterdir()] == ["orbit.mp4"]


def test_a_film_that_fails_leaves_nothing_behind(tmp_path):
    def broken():
        yield np.zeros((240, 240, 3), np.uint8)
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        write_pictures(tmp_path / "film.mp4", broken(), fps=10)
    assert list(tmp_path.iterdir()) == []


def filmed(model, views, images, settings):
    """The pictures of a film of held-out images beside a learned scene."""
    shown = partial(still, Renderer(model))
    times = held_out_times(views, images)
    pictures = held_out_pictures(
        shown, model.moves, views, images, times, settings, background="white"
    )
    return [*pictures]


def test_held_out_pictures_are_rendered_in_the_films_size_beside_the_truth(moving, tiny_scene):
    views, film = tiny_scene.dynamic.test, VideoSettings(height=36)
    images = held_out_images(views, 3)
    shown = filmed(moving, views, images, film)
    large = views.cameras.of_height(36)
    assert [tuple(image.shape) for image in shown] == [(18 + 36, 3 * 48 + 8, 3)] * 3
    for image, index, time in zip(shown, images, (0.0, 0.5, 1.0), strict=True):
        truth, rendered = image[18:, :48], image[18:, 52:100]
        assert torch.equal(truth, to_bytes(scaled(truth_image(views, index, "white"), 36)))
        seen = plain_picture(moving, large.image_rays(index), time, torch.ones(3))
        shades = rendered.reshape(-1, 3) / 255
        torch.testing.assert_close(shades, seen.color, atol=0.51 / 255, rtol=0)


def test_held_out_images_of_a_moving_camera_are_shown_at_their_own_times(moving, tiny_scene):
    views = tiny_scene.dynamic.test
    walked = replace(views, view=torch.arange(len(views)))
    renderer = Renderer(moving)
    images = held_out_images(walked, 2 * len(walked))
    film = VideoSettings(height=18)
    shown = filmed(moving, walked, images, film)
    for image, picture in zip(images, shown, strict=True):
        color, _ = still(renderer, walked.cameras, float(walked.times[image]), 1.0, image)
        assert torch.equal(picture[18:, 28:52], to_bytes(color))
    # Each is rendered once.
    assert len({id(picture) for picture in shown}) == len(set(images))


def test_pictures_of_two_sizes_have_their_own_within_a_video_of_one(moving, two_sizes, tmp_path):
    views, renderer = two_sizes.dynamic.test, Renderer(moving)
    film = VideoSettings(height=18)
    shown = filmed(moving, views, [0, 1], film)
    assert [picture.shape for picture in shown] == [(36, 3 * 24 + 2 * 4, 3)] * 2
    for image, picture in enumerate(shown):
        truth = to_bytes(truth_image(views, image, "white"))
        height, width = truth.shape[:2]
        top, left = 18 + (18 - height) // 2, (24 - width) // 2
        assert (width, height) == [(18, 18), (24, 16)][image]
        assert torch.equal(picture[top : top + height, left : left + width], truth)
        color, depth = still(renderer, views.cameras, (0.0, 1.0)[image], 1.0, image)
        assert color.shape == depth.shape == (height, width, 3)
        at = left + 28
        assert torch.equal(picture[top : top + height, at : at + width], to_bytes(color))
    sheet = [score(renderer, views, k, "white") for k in range(2)]
    assert write_contact_sheet(tmp_path / "sheet.png", sheet).shape[0] == 30 + 2 * 306 - 6


def test_a_video_of_cameras_of_several_sizes_has_the_commonest(two_sizes):
    cameras = two_sizes.static.train.cameras[[0, 1, 3]]  # 18 x 18, twice 24 x 16
    larger = sized(cameras, VideoSettings().height)
    assert (larger.width, larger.height) == (600, 400) and larger.sizes is None
    assert torch.equal(larger.camera_to_world, cameras.camera_to_world)
    assert larger.focal[1].tolist() == (cameras.focal[1] * 25).tolist()
    one = StillSettings(view=0).camera(Viewpoints.of(two_sizes))
    assert (one.width, one.height) == (400, 400)


def test_films_of_a_scene_at_rest_speak_of_no_time(learned, tiny_scene, monkeypatch):
    headings = []
    monkeypatch.setattr("devrf.apps.video.image_grid", lambda _, heads: headings.extend(heads))
    model, views = learned[0].scene_model, tiny_scene.dynamic.test
    list(path_pictures(Renderer(model), views.cameras[[0]], 1.0))
    filmed(model, views, [1], VideoSettings(height=18))
    depth = "depth: near is bright"
    assert headings == ["rendered", depth, "truth (24x18)", "rendered", depth]


def test_held_out_images_are_the_nearest_in_time(tiny_scene):
    views = tiny_scene.dynamic.test
    assert len(set(views.view.tolist())) == 1
    times = views.times[held_out_images(views, 7)]
    wanted = torch.linspace(0, 1, 7)
    apart = (times[:, None] - views.times).abs().amin(dim=1)
    assert not apart.any() and ((times - wanted).abs() <= 0.51 * views.times.diff().max()).all()
    # Of several fixed cameras the first; images at rest one after another.
    two = replace(views, view=torch.arange(len(views)) % 2)
    assert {int(two.view[k]) for k in held_out_images(two, 7)} == {0}
    moved = replace(views, view=torch.arange(len(views)))
    rest = replace(moved, times=torch.zeros(len(views)))
    assert held_out_images(rest, len(views)) == list(range(len(views)))


def test_rendering_keeps_to_its_seconds():
    film = VideoSettings(max_seconds=12)
    assert film.within_limit(0.1, 400) == film
    # A quarter of the pixels, then the fewest rows and half the frames; 24 a second all the same.
    assert film.within_limit(0.4, 400) == replace(film, height=200)
    assert film.within_limit(0.8, 320) == replace(film, height=160, frames=60)
    assert film.within_limit(100.0, 96) == replace(film, height=96, frames=24)
    assert VideoSettings().within_limit(100.0, 400) == VideoSettings()


def test_the_camera_that_is_meant(tiny_scene):
    held_out = StillSettings().camera(Viewpoints.of(tiny_scene))
    assert torch.equal(held_out.positions, tiny_scene.dynamic.test.cameras.positions[:1])
    # The images are 24 x 18: pictures of them are rendered 400 pixels high.
    assert (held_out.width, held_out.height) == (533, 400)
    fifth = StillSettings(view=5, height=36).camera(Viewpoints.of(tiny_scene))
    assert torch.equal(fifth.positions, tiny_scene.static.train.cameras.positions[5:6])
    assert (fifth.width, fifth.height) == (48, 36)


@pytest.mark.parametrize(
    ("settings", "given", "expected"),
    [
        (StillSettings, {"view": -1}, "still.view: "),
        (StillSettings, {"height": 0}, "still.height: "),
        (VideoSettings, {"height": 15}, "video.height: "),
        (StillSettings, {"height": 10**9}, "still.height: "),
        (VideoSettings, {"height": 10**9}, "video.height: "),
        *[(VideoSettings, {"fps": x}, "video.fps: ") for x in (1e-300, 0, -1, 1e300, math.nan)],
        *[(VideoSettings, {"orbit_turns": x}, "video.orbit_turns: ") for x in (1e300, math.inf)],
        (VideoSettings, {"orbit_elevation": 1e30}, "video.orbit_elevation: "),
        (VideoSettings, {"max_seconds": 0}, "video.max_seconds: "),
        (VideoSettings, {"time": 1.5}, "video.time: "),
    ],
)
def test_what_cannot_be_shown(tiny_scene, settings, given, expected):
    with pytest.raises(DevrfError, match=expected):
        settings(**given).camera(Viewpoints.of(tiny_scene))

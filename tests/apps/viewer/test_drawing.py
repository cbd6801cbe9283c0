"""What the page shows of a scene: as the renderer, in blocks, and what its method has."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.apps.images import to_bytes
from devrf.apps.viewer.cameras import Pose, bare_frusta, moving_frusta, resting_frusta
from devrf.apps.viewer.drawing import Drawing, Picture, Shot
from devrf.methods.nerf.ray_view import RayView
from devrf.rendering.renderer import Renderer


def drawn(drawing: Drawing, shot: Shot, height: int = 18) -> Picture:
    *blocks, picture = drawing.draw(shot, height)
    assert blocks and not any(blocks)
    return picture


@pytest.fixture
def drawing(moving) -> Drawing:
    return Drawing(Renderer(moving, times=6), 1.0)


@pytest.fixture
def shot(tiny_scene) -> Shot:
    return Shot(Pose.of_cameras(tiny_scene.dynamic.test.cameras, 0), 0.7)


def test_the_picture_is_the_renderers(drawing, shot, moving, tiny_scene):
    picture = drawn(drawing, shot)
    camera = shot.pose.camera(18)
    seen = Renderer(moving).view(camera, 0, 0.7, 1.0)
    expected = to_bytes(seen.color.view(18, 24, 3))
    assert picture.pixels.shape == (18, 24, 3) and picture.depth is None
    assert int((picture.pixels.int() - expected.int()).abs().max()) <= 1
    assert len(torch.unique(picture.pixels)) > 20


def test_blocks_can_be_of_any_size(drawing, shot, monkeypatch):
    whole = drawn(drawing, shot).pixels
    monkeypatch.setattr("devrf.apps.viewer.drawing.FEWEST", 100)
    monkeypatch.setattr("devrf.apps.viewer.drawing.BLOCK_SECONDS", 0)
    *blocks, picture = drawing.draw(shot, 18)
    assert len(blocks) == 5  # 432 pixels
    assert int((picture.pixels.int() - whole.int()).abs().max()) <= 1


def test_a_scene_that_moves_offers_motion_and_its_rest_state(drawing):
    assert drawing.channels == ("color", "depth", "opacity", "motion")
    assert drawing.has_rest and not drawing.at_rest


def test_a_scene_at_rest_offers_neither(learned):
    drawing = Drawing(Renderer(learned[0].scene_model), 1.0)
    assert drawing.channels == ("color", "depth", "opacity")
    assert drawing.at_rest and not drawing.has_rest


def test_a_method_without_motion_or_rest_state_offers_neither(moving):
    class Other:
        device, space, box, depth_limits = moving.device, moving.space, moving.box, (0.0, 1.0)

        def at(self, time: float, *, half: bool = False) -> RayView:
            return RayView(self, time, self.device, at_rest=False, half=half)

    drawing = Drawing(Renderer(Other()), 1.0)
    assert drawing.channels == ("color", "depth", "opacity")
    assert not drawing.has_rest and not drawing.at_rest


@pytest.mark.parametrize("channel", ["depth", "opacity", "motion"])
def test_each_channel_has_a_picture_of_its_own(drawing, shot, channel):
    color = drawn(drawing, shot).pixels
    other = drawn(drawing, replace(shot, channel=channel)).pixels
    assert other.shape == color.shape and not torch.equal(other, color)


def test_opacity_is_white_where_something_is(drawing, shot):
    seen = drawn(drawing, replace(shot, channel="opacity")).pixels
    assert int(seen[0, 0, 0]) == 0 and int(seen.max()) > 200


def test_the_rest_state_is_on_the_left(drawing, shot):
    beside = drawn(drawing, replace(shot, beside_rest=True)).pixels
    half = replace(shot, pose=replace(shot.pose, aspect=shot.pose.aspect / 2))
    assert torch.equal(beside[:, :12], drawn(drawing, replace(half, time=0.0)).pixels)
    assert torch.equal(beside[:, 12:], drawn(drawing, half).pixels)
    assert not torch.equal(beside[:, :12], beside[:, 12:])


def test_depth_is_along_the_axis_and_far_where_nothing_is(drawing, shot, moving):
    depth = drawn(drawing, replace(shot, with_depth=True)).depth
    seen = Renderer(moving).view(shot.pose.camera(18), 0, 0.7, 1.0)
    solid = (seen.opacity > 0.5).view(18, 24)
    assert float(depth[~solid].min()) == 1000
    assert bool((depth[solid] < seen.depth.view(18, 24)[solid] + 1e-4).all())
    assert bool((depth[solid] > 0.9 * seen.depth.view(18, 24)[solid]).all())


def test_a_picture_is_as_large_as_the_time_for_it_allows(drawing, shot):
    drawing._rays_per_second, drawing._overhead = 10_000.0, 0.0
    assert drawing.height_within(1.0, 1.0, 480) == 100
    assert drawing.height_within(1.0, 4.0, 480) == 50
    assert drawing.height_within(100.0, 1.0, 480) == 480
    assert drawing.height_within(1e-9, 1.0, 480) == 16


def test_cameras_have_the_pictures_of_the_nearest_time(tiny_scene):
    views = tiny_scene.dynamic.train
    early, late = moving_frusta(tiny_scene, 0.1), moving_frusta(tiny_scene, 0.97)
    assert [one.name for one in early] == [one.name for one in late] == ["moving/0", "moving/1"]
    last = int((views.times == 1).nonzero()[0, 0])
    pixels = views.pixels[last].float()
    expected = 255 + pixels[..., 3:] / 255 * (pixels[..., :3] - 255)
    assert float((late[0].picture.float() - expected).abs().max()) <= 1
    assert not torch.equal(early[0].picture, late[0].picture)


def test_cameras_at_rest_have_pictures_where_images_were_read(tiny_scene):
    read, unread = resting_frusta(tiny_scene), bare_frusta(tiny_scene.static.train.cameras)
    assert [one.pose for one in read] == [one.pose for one in unread]
    assert len(read) == 8 and all(one.picture is not None for one in read)
    assert all(one.picture is None for one in unread)

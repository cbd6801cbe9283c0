"""The page of an inspection: its panels and labels, and what they show."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import imageio.v3 as iio
import torch

from devrf.apps.inspection.picture import (
    compass,
    frusta,
    inspection_figure,
    shown,
    write_inspection_picture,
)
from devrf.geometry.cameras import Cameras


def captions(figure):
    """Labels below the images of a page."""
    return [label for axes in figure.axes[2:] if (label := axes.get_xlabel())]


def headings(figure):
    return "\n".join(part.get_suptitle() for part in figure.subfigs)


def test_the_page_of_a_scene(tiny_scene, tmp_path, monkeypatch):
    figure = inspection_figure(tiny_scene)
    monkeypatch.setattr("devrf.apps.inspection.picture.inspection_figure", lambda _: figure)
    write_inspection_picture(tmp_path / "images" / "inspect.png", tiny_scene)
    assert iio.imread(tmp_path / "images" / "inspect.png").shape[1] == 1600
    for part in ("robot, inward-facing", "set: 8 images", "2 fixed views, 3 times", "Optical flow"):
        assert part in headings(figure)
    (legend,) = figure.subfigs[0].legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert {"box", "room for motion", "static views (8)", "dynamic views (2)"} <= set(labels)
    plan = {text.get_text() for text in figure.axes[1].texts}
    assert plan == {"view 0", "view 1", "test 0"}
    rows = [f"view {view}, time {time}" for view in (0, 1) for time in ("0.00", "0.50", "1.00")]
    found = captions(figure)
    assert found[:1] == ["static train 000"] and found[6:12] == rows
    # Of each view's first image there is no flow; the first place shows the wheel instead.
    assert found[12].startswith("rim: ") and found[13:] == rows[1:3] + rows[4:]


def test_a_camera_is_a_pyramid_that_opens_where_it_looks():
    cameras = Cameras(
        torch.eye(3, 4)[None], torch.tensor([[10.0, 10.0]]), torch.tensor([[10.0, 5.0]]), 20, 10
    )
    lines = frusta(cameras, depth=2.0)
    assert lines.shape == (10, 2, 3)
    # The image's top left corner: 10 left and 5 up at focal length 10, 2 away along -z.
    torch.testing.assert_close(lines[0], torch.tensor([[0.0, 0, 0], [-2.0, 1.0, -2.0]]))
    # The tick above it shows which way is up.
    torch.testing.assert_close(lines[8, 1], torch.tensor([0.0, 1.4, -2.0]))


def test_forward_facing_cameras_look_north():
    cameras = Cameras(torch.eye(3, 4).repeat(3, 1, 1), torch.ones(3, 2), torch.ones(3, 2), 2, 2)
    views = SimpleNamespace(train=SimpleNamespace(cameras=cameras))
    forward_scene = SimpleNamespace(kind="forward", static=views)
    east_north_up = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(compass(forward_scene), east_north_up, atol=1e-5, rtol=0)


def test_what_alpha_or_masks_leave_out_is_chequered(tiny_scene):
    views = tiny_scene.static.train[torch.tensor([0])]
    pixels = torch.tensor([255, 0, 0, 255], dtype=torch.uint8).expand(1, 18, 24, 4).clone()
    left = (torch.arange(24) < 12).expand(1, 18, 24)
    cut_out = pixels * torch.stack([torch.ones_like(left)] * 3 + [left], dim=-1)
    for changed in (
        replace(views, pixels=cut_out),
        replace(views, pixels=pixels, valid_mask=left),
        replace(views, pixels=pixels[..., :3], valid_mask=left),
    ):
        image = shown(changed, 0)
        assert (image[:, :12] == [255, 0, 0]).all()
        assert set(image[:, 12:].reshape(-1).tolist()) == {232, 255}


def test_letters_that_the_font_lacks_are_drawn_without_a_warning(tiny_scene, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_inspection_picture(tmp_path / "page.png", replace(tiny_scene, name="旗"))

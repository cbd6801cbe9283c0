"""Mattes that other programs made become alpha; what moves says where the box is."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from devrf.apps.capture.images import Chosen, box_of_motion, mattes_of, silhouettes, write_frames
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras

SIZE = (64, 48)


def matte(level, size=SIZE):
    """A matte whose left half is white, the rest of a grey level."""
    grey = np.full(size[::-1], level, np.uint8)
    grey[:, : size[0] // 2] = 255
    return grey


@pytest.fixture
def walk(film, textured):
    """A video of four frames."""
    return film("walk.mp4", [textured(k) for k in range(4)])


@pytest.fixture
def mattes(tmp_path):
    """The mattes of its frames, each with another level on the right."""
    folder = tmp_path / "mattes" / "walk"
    folder.mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), matte(k))
    return folder.parent


def written(footage, into, size=SIZE):
    """The images (H, W, 4) RGBA that are written of some footage."""
    paths = list(write_frames(into, footage, size, SIZE))
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]


def test_a_folder_of_mattes_becomes_the_alpha_of_a_video(walk, mattes, tmp_path):
    found = mattes_of(mattes, walk, 4)
    one, other = written(Chosen(walk, "static", (1, 3), found), tmp_path / "images")
    assert (one[..., 3] == matte(1)).all() and (other[..., 3] == matte(3)).all()
    small = written(Chosen(walk, "static", (2,), found), tmp_path / "images", (32, 24))[0]
    assert small.shape == (24, 32, 4) and (small[:, :15, 3] == 255).all()


def test_a_video_of_mattes_is_taken_frame_by_frame(walk, tmp_path, film):
    (tmp_path / "cut").mkdir()
    grey = [np.full((48, 64, 3), level, np.uint8) for level in (0, 80, 160, 240)]
    film("cut/walk.mp4", grey)
    found = mattes_of(tmp_path / "cut", walk, 4)
    shown = written(Chosen(walk, "static", (1, 3), found), tmp_path / "images")
    for image, level in zip(shown, (80, 240), strict=True):
        assert image[..., 3].astype(float).mean() == pytest.approx(level, abs=3)


def test_photographs_have_mattes_of_their_names(tmp_path, textured, mattes):
    (tmp_path / "walk").mkdir()
    for k in (1, 3):
        cv2.imwrite(str(tmp_path / "walk" / f"{k}.jpg"), textured(k))
    found = mattes_of(mattes, tmp_path / "walk", 2)
    shown = written(Chosen(tmp_path / "walk", "static", (0, 1), found), tmp_path / "images")
    assert [int(image[0, -1, 3]) for image in shown] == [1, 3]
    (mattes / "walk" / "3.png").unlink()
    with pytest.raises(DevrfError, match=r"mattes/walk/3\.png: no such matte, of .*walk/3\.jpg"):
        mattes_of(mattes, tmp_path / "walk", 2)


def test_mattes_that_do_not_fit_are_refused(walk, mattes, tmp_path, film):
    with pytest.raises(DevrfError, match=r"nowhere: no such folder of mattes; correct capture\.m"):
        mattes_of(tmp_path / "nowhere", walk, 4)
    with pytest.raises(DevrfError, match=r"mattes/left: no such folder, expected the mattes of .*"):
        mattes_of(mattes, Path("left.mp4"), 4)
    with pytest.raises(DevrfError, match=r"walk: 4 mattes, but .*walk\.mp4 has 5 frames; give an"):
        mattes_of(mattes, walk, 5)
    cv2.imwrite(str(mattes / "walk" / "2.png"), matte(0, (32, 24)))
    with pytest.raises(DevrfError, match=r"2\.png: 32x24 px, but its image .* has 64x48 px"):
        written(Chosen(walk, "static", (2,), mattes / "walk"), tmp_path / "images")
    short = film("short.mp4", [np.zeros((48, 64, 3), np.uint8)] * 2)
    with pytest.raises(DevrfError, match=r"short\.mp4: ends after 2 frames, expected 4 or more"):
        written(Chosen(walk, "static", (0, 3), short), tmp_path / "images")
    with pytest.raises(DevrfError, match=r"capture\.mattes: subtract needs at least 2 views"):
        CaptureSettings(static="s.mp4", views=["a.mp4"], into="x", mattes="subtract").check()


@pytest.fixture
def ring():
    """Four cameras around the origin, 96×96."""
    angle = torch.arange(4) * torch.pi / 2 + 0.4
    around = torch.stack([4 * angle.cos(), 4 * angle.sin(), torch.full_like(angle, 1.5)], dim=1)
    return Cameras.looking_at(around, torch.zeros_like(around), focal=100.0, width=96, height=96)


def seen(ring, camera, center, background):
    """A white ball of radius 0.3 before the background."""
    place, depth = ring.project(torch.tensor([camera]), torch.tensor([center]))
    picture = background.copy()
    at = tuple((place[0].numpy() * 16).round().astype(int).tolist())
    radius = round(16 * 0.3 * 100 / float(depth))
    return cv2.circle(picture, at, radius, (255, 255, 255), -1, cv2.LINE_8, 4)


def test_what_moves_says_where_the_box_is(ring, tmp_path):
    names, generator = [], np.random.default_rng(0)
    for v in range(4):
        wall = generator.integers(0, 180, (24, 24, 3), dtype=np.uint8)
        wall = cv2.resize(wall, (96, 96), interpolation=cv2.INTER_LINEAR)
        names.append([f"view{v}/{t}.png" for t in range(12)])
        (tmp_path / f"view{v}").mkdir()
        for t, name in enumerate(names[-1]):
            noise = generator.integers(-2, 3, wall.shape)
            picture = seen(ring, v, [2 * t / 11 - 1, 0.0, 0.2], wall)
            cv2.imwrite(str(tmp_path / name), (picture + noise).clip(0, 255).astype(np.uint8))
    lens = {"fl_x": 100.0, "fl_y": 100.0, "cx": 48.0, "cy": 48.0, "w": 96, "h": 96}
    around = Box.of([-2.0] * 3, [2.0] * 3)
    poses = ring.camera_to_world.double()
    box = box_of_motion(tmp_path, names, poses, [lens] * 4, around)
    exact = [(-1.3, 1.3), (-0.3, 0.3), (-0.1, 0.5)]
    for low, high, (least, most) in zip(box.low, box.high, exact, strict=True):
        assert least - 0.35 < low <= least + 0.1 and most - 0.1 <= high < most + 0.35
    still = [[view[0]] * 3 for view in names]
    with pytest.raises(DevrfError, match=r"capture\.mattes: subtract needs at least 2 fixed views"):
        box_of_motion(tmp_path, still, poses, [lens] * 4, around)


def test_noise_is_no_silhouette():
    generator = np.random.default_rng(1)
    wall = generator.integers(20, 230, (48, 64, 3))
    pictures = [(wall + generator.normal(0, 2, wall.shape)).astype(np.uint8) for _ in range(10)]
    assert not any(mask.any() for mask in silhouettes(pictures))

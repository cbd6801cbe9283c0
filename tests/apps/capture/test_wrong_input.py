"""What is wrong with footage is said in one line, and nothing is left behind."""

from __future__ import annotations

import importlib.util

import cv2
import numpy as np
import pytest

from devrf.apps.capture.pipeline import scene_from_footage
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError


def refused(into, **settings):
    """The line that a capture ends with; its folder is no scene then."""
    with pytest.raises(DevrfError) as error:
        scene_from_footage(CaptureSettings(into=into, **settings))
    line = str(error.value)
    assert "\n" not in line and not (into / "transforms.json").exists()
    return line


@pytest.fixture
def into(tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.apps.capture.pipeline.check_library", lambda: None)
    return tmp_path / "scene"


def test_settings_that_do_not_go_together(into):
    none = CaptureSettings(static="a.mp4")
    with pytest.raises(DevrfError, match=r"^capture\.into: stage=capture needs a folder"):
        none.check()
    assert refused(into).startswith("capture.static: needs a video, or a folder of photographs")
    two = {"static": "s.mp4", "views": ["a.mp4", "b.mp4"]}
    assert refused(into, **two, offsets=[0]).startswith("capture.offsets: 1 offsets for 2 views")
    assert refused(into, **two, test_view=3).startswith("capture.test_view: 3 is none of the 2")
    assert refused(into, **two, frames=2) == "capture.frames: expected at least 3, not 2"
    assert CaptureSettings(views=["a.mp4"]).monocular
    assert CaptureSettings(static="a.mp4", views=["a.mp4"]).monocular
    assert not CaptureSettings(static="s.mp4", views=["a.mp4"]).monocular


def test_footage_that_cannot_be_read(into, tmp_path, film, textured, capfd):
    missing = tmp_path / "no.mp4"
    assert refused(into, static=missing).startswith(f"{missing}: no such video; correct capture.")
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(b"not a video" * 50)
    assert refused(into, static=damaged).startswith(f"{damaged}: not a readable video; convert it")
    assert not into.exists() and capfd.readouterr().err == ""  # nor do libraries say anything
    short = film("short.mp4", [textured(0)])
    expected = f"{short}: a video of 1 frame, expected at least 2; give a longer one"
    assert refused(into, static=short).startswith(expected)


def test_blurred_footage(into, film, textured):
    large = [cv2.resize(textured(k), (256, 192)) for k in range(6)]
    pictures = [cv2.GaussianBlur(one, (0, 0), 7) for one in large]
    blurred = film("blurred.mp4", pictures)
    assert "sharpest frames are blurred; film more slowly" in refused(into, static=blurred)


def test_a_folder_that_is_something_else(into, film, textured):
    into.mkdir()
    (into / "mine.txt").touch()
    video = film("a.mp4", [textured(k) for k in range(4)])
    assert refused(into, static=video).startswith(f"{into}: is there already, and not from stage=")


def test_a_folder_that_cannot_be_made(tmp_path, into, film, textured):
    (tmp_path / "file").touch()
    video = film("a.mp4", [textured(k) for k in range(4)])
    with pytest.raises(
        DevrfError, match=r"file/scene/capture: cannot be made \(Not a directory\);"
    ):
        scene_from_footage(CaptureSettings(static=video, into=tmp_path / "file" / "scene"))


def test_views_without_motion_in_common(into, film, textured):
    static = film("static.mp4", [textured(k) for k in range(4)])
    still = film("still.mp4", [textured(1)] * 4)
    other = film("other.mp4", [textured(k) for k in (1, 2, 2, 3)])
    line = refused(into, static=static, views=[other, still])
    assert line.startswith(f"{still}: nothing moves in it; give capture.offsets=")


@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="needs devrf[capture]")
def test_footage_without_overlap(into, film):
    generator = np.random.default_rng(0)
    pictures = generator.integers(0, 256, (4, 96, 128, 3), dtype=np.uint8)
    static = film("static.mp4", list(pictures))
    line = refused(into, static=static)
    assert line.startswith(f"{static}: too few matches between its frames to find any camera; film")
    # What the steps before have found stays.
    assert (into / "capture" / "images.json").is_file()


def test_the_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("devrf.apps.capture.structure.find_spec", lambda name: None)
    with pytest.raises(DevrfError) as error:
        scene_from_footage(CaptureSettings(static="a.mp4", into=tmp_path / "scene"))
    expected = 'stage=capture: pycolmap is not installed; run pip install "devrf[capture]"'
    assert str(error.value) == expected

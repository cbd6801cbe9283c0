"""Sharpness, motion, and the frames that are picked for them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.apps.capture.survey import BLURRED, check_sharp, moved, sharpest, sharpness, survey
from devrf.errors import DevrfError


def test_blur_lowers_sharpness_whatever_the_contrast(textured):
    grey = textured(0)[..., 0].astype(np.float32)
    sharp = sharpness(grey)
    assert sharpness(0.3 * grey + 20) == pytest.approx(sharp, abs=1e-4)
    slight, strong = (sharpness(cv2.GaussianBlur(grey, (0, 0), s)) for s in (1.5, 5.0))
    assert sharp > 0.8 > slight > 0.5 > BLURRED > strong
    assert sharpness(np.full((48, 64), 7, np.float32)) == 0


def test_motion_is_what_exceeds_noise_and_changes_of_all_pixels():
    before = np.full((10, 10), 100, np.float32)
    assert moved(before, before + 30) == 0  # exposure
    after = before.copy()
    after[:, :2] += 12
    assert moved(before, after) == pytest.approx(0.2 * (12 - 2))


def test_the_sharpest_of_each_stretch_is_picked():
    assert sharpest([0.1, 0.9, 0.2, 0.8, 0.3, 0.4], 3) == [1, 3, 5]
    assert sharpest([0.5, 0.4], 3) == [0, 1]


def test_blurred_footage_is_refused():
    with pytest.raises(DevrfError, match=r"a\.mp4: 2 of its 3 sharpest frames are blurred; film"):
        check_sharp(Path("a.mp4"), [0.1, 0.1, 0.6], [0, 1, 2])
    with pytest.raises(DevrfError, match=r"a\.mp4: 2 images, expected at least 3"):
        check_sharp(Path("a.mp4"), [0.6, 0.6], [0, 1])


def test_a_video_is_surveyed_frame_by_frame(film, textured):
    rest, other = textured(0), textured(1)
    blurred = cv2.GaussianBlur(rest, (0, 0), 4)
    found = survey(film("a.mp4", [rest, rest, other, blurred], rate=5))
    assert found.size == (64, 48)
    assert found.times == pytest.approx([0, 0.2, 0.4, 0.6], abs=1e-3)
    assert found.rate == pytest.approx(5, rel=1e-3)
    assert found.motion[:2] == (0, pytest.approx(0, abs=0.5)) and found.motion[2] > 5
    assert found.sharpness[3] < 0.5 < found.sharpness[0]
    assert found.of(found.plain()) == found

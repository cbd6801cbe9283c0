"""What structure from motion is asked for, and what is made of its model."""

from __future__ import annotations

from pathlib import Path

import pytest

from devrf.apps.capture.images import Chosen, common_size, fitted
from devrf.apps.capture.structure import checked_model, pairs
from devrf.errors import DevrfError

MOVING = Chosen(Path("walk.mp4"), "static", (0, 10, 20, 30))


def model(folder, *names):
    folder.mkdir()
    (folder / "cameras.txt").write_text("# cameras\n1 SIMPLE_PINHOLE 64 48 50 32 24\n")
    lines = [f"{k} 1 0 0 0 0 0 {k} 1 {name}\n\n" for k, name in enumerate(names, 1)]
    (folder / "images.txt").write_text("".join(lines))
    return folder


def test_sequential_matching_leaves_out_what_is_far_in_order():
    moving, fixed = [str(k) for k in range(30)], ["a", "b"]
    assert len(pairs(moving, fixed, "exhaustive")) == 32 * 31 / 2
    chosen = set(pairs(moving, fixed, "sequential"))
    assert {("0", "10"), ("0", "20"), ("29", "a"), ("a", "b")} <= chosen
    assert ("0", "11") not in chosen and ("0", "21") not in chosen


def test_a_view_that_was_not_placed_is_named(tmp_path):
    folder = model(tmp_path / "model", *MOVING.names, "view1/00003.png")
    fixed = {"view1/00003.png": Path("left.mp4")}
    assert len(checked_model(folder, MOVING, fixed).images) == 5
    with pytest.raises(DevrfError, match=r"right\.mp4: its camera could not be placed among"):
        checked_model(folder, MOVING, {**fixed, "view2/00000.png": Path("right.mp4")})


def test_a_model_of_a_few_frames_is_not_the_scene(tmp_path):
    folder = model(tmp_path / "model", *MOVING.names[:2], "view1/00003.png")
    with pytest.raises(DevrfError, match=r"walk\.mp4: cameras were found for 2 of 4 frames only"):
        checked_model(folder, MOVING, {})


def test_cameras_that_jump_within_a_video_are_refused(tmp_path):
    names = [f"static/{k:05d}.png" for k in range(6)]
    moving = Chosen(Path("walk.mp4"), "static", tuple(range(6)))
    folder = model(tmp_path / "model", *names)
    # The last two look the other way: half a turn about y.
    text = (folder / "images.txt").read_text().splitlines(keepends=True)
    turned = [
        line.replace(" 1 0 0 0 ", " 0 0 1 0 ") if k >= 8 else line for k, line in enumerate(text)
    ]
    (folder / "images.txt").write_text("".join(turned))
    expected = r"walk\.mp4: between 00003 and 00004, .* its camera seems to turn by 180 degrees"
    with pytest.raises(DevrfError, match=expected):
        checked_model(folder, moving, {})
    (tmp_path / "photographs").mkdir()
    photographs = Chosen(tmp_path / "photographs", "static", tuple(range(6)))
    assert len(checked_model(folder, photographs, {}).images) == 6


def test_frames_are_cropped_to_common_proportions_and_shrunk(textured):
    a, b = Path("a.mp4"), Path("b.mp4")
    assert common_size({a: (1920, 1080), b: (1280, 720)}, 960) == (960, 540)
    with pytest.raises(DevrfError, match=r"b\.mp4: 720x1280 px, but a\.mp4 has 1920x1080 px; hold"):
        common_size({a: (1920, 1080), b: (720, 1280)}, 960)
    picture = textured(0)
    assert (fitted(picture, (48, 48)) == picture[:, 8:56]).all()
    assert fitted(picture, (32, 24)).shape == (24, 32, 3)

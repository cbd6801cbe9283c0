"""The steps of a capture: survey, alignment, images with alpha masks, structure."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from devrf.apps.capture import images
from devrf.apps.capture.alignment import offset_between, timeline
from devrf.apps.capture.images import (
    Chosen,
    chosen_masks,
    common_size,
    fitted,
    masks_of,
    motion_masks,
    write_frames,
)
from devrf.apps.capture.pipeline import _model, kept, scene_from_footage
from devrf.apps.capture.structure import MODELS, checked_model, pairs
from devrf.apps.capture.survey import (
    BLURRED,
    Survey,
    check_sharp,
    moved,
    sharpest,
    sharpness,
    survey,
)
from devrf.apps.settings import CaptureSettings
from devrf.errors import DevrfError
from devrf.scenes.image_folders import listed_images as list_of

SIZE = (64, 48)
PATHS = [Path("a.mp4"), Path("b.mp4")]


@pytest.mark.parametrize("text", ["{", "[]", '{"key": 1}', "[" * 100_000])
def test_a_damaged_record_of_a_step_is_one_line(tmp_path, text):
    (tmp_path / "survey.json").write_text(text)
    with pytest.raises(
        DevrfError, match=r"survey\.json: damaged; remove it, and it is made again$"
    ):
        kept(tmp_path / "survey.json", "videos", dict[str, Any], dict)


SEEN = {"size": [64, 48], "times": [0.0, 0.1], "sharpness": [1.0, 1.0], "motion": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("size", [0, -1]),
        ("size", "large"),
        *[("times", x) for x in ([], [0.0], [0.0, math.nan], [1.0, 0.0], [0, 10**400], {}, None)],
        *[("sharpness", x) for x in ([1.0], [math.inf, 1.0], ["x", "y"])],
        ("motion", [0.0] * 10_000),
    ],
)
def test_a_record_of_a_step_that_holds_something_else_is_one_line(tmp_path, key, value):
    file = tmp_path / "survey.json"
    assert kept(file, "videos", Survey, lambda: SEEN) == kept(file, "videos", Survey, dict)
    record = json.loads(file.read_text())
    for result in ({**SEEN, key: value}, [value], value):
        file.write_text(json.dumps({**record, "result": result}))
        with pytest.raises(DevrfError, match=r"survey\.json: damaged; remove it"):
            kept(file, "videos", Survey, dict)


@pytest.mark.parametrize("name", ["../../../elsewhere", "/etc", "a/../..", "", "a\0b"])
def test_a_model_is_in_the_folder_of_models(tmp_path, monkeypatch, name):
    work, film = tmp_path / "capture", tmp_path / "a.mp4"
    film.touch()
    monkeypatch.setattr("devrf.apps.capture.pipeline.reconstruct", lambda *_: work / MODELS / "0")
    arguments = (tmp_path, work, Chosen(film, "static", (0,)), [], CaptureSettings())
    with pytest.raises(DevrfError, match="0: not a readable COLMAP model"):
        _model(*arguments)
    record = json.loads((work / "structure.json").read_text())
    (work / "structure.json").write_text(json.dumps({**record, "result": {"model": name}}))
    with pytest.raises(DevrfError, match="(leads outside the scene's folder|is not a path)"):
        _model(*arguments)


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="needs devrf[capture]")
@pytest.mark.parametrize("name", ["images", "images/static", "capture/masks", "transforms.json"])
def test_nothing_of_a_capture_is_written_through_a_link(tmp_path, name):
    into = tmp_path / "scene"
    (into / "capture").mkdir(parents=True)
    (into / name).parent.mkdir(exist_ok=True)
    (into / name).symlink_to(tmp_path / "else")
    with pytest.raises(DevrfError, match=f"scene/{name}: a link or a pipe; remove it"):
        scene_from_footage(CaptureSettings(static="a.mp4", into=into))
    assert not (tmp_path / "else").exists()


# Survey.


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


def test_the_sharpest_of_each_stretch_is_picked_and_blurred_footage_refused():
    assert sharpest([0.1, 0.9, 0.2, 0.8, 0.3, 0.4], 3) == [1, 3, 5]
    assert sharpest([0.5, 0.4], 3) == [0, 1]
    with pytest.raises(DevrfError, match=r"^a\.mp4: 2 of its 3"):
        check_sharp(Path("a.mp4"), [0.1, 0.1, 0.6], [0, 1, 2])


def test_a_video_is_surveyed_frame_by_frame(film, textured):
    rest, other = textured(0), textured(1)
    blurred = cv2.GaussianBlur(rest, (0, 0), 4)
    seen = survey(film("a.mp4", [rest, rest, other, blurred], rate=5))
    assert seen.size == SIZE
    assert seen.times == pytest.approx([0, 0.2, 0.4, 0.6], abs=1e-3)
    assert seen.rate == pytest.approx(5, rel=1e-3)
    assert seen.motion[:2] == (0, pytest.approx(0, abs=0.5)) and seen.motion[2] > 5
    assert seen.sharpness[3] < 0.5 < seen.sharpness[0]


# Alignment.


def bursts():
    """Motion that starts and stops irregularly, over ten seconds."""
    generator = np.random.default_rng(0)
    times, heights = generator.uniform(0, 10, 12), generator.uniform(1, 5, 12)

    def motion(at):
        return sum(h * np.exp(-((at - t) ** 2) / 0.08) for t, h in zip(times, heights, strict=True))

    return motion


def test_the_offset_is_found_within_a_quarter_of_a_frame(surveyed):
    first = surveyed(bursts(), 30, 8, begin=1.5)
    second = surveyed(bursts(), 24, 7, begin=1.5 - 0.77)
    found = offset_between(first, second)
    assert found.seconds == pytest.approx(-0.77, abs=0.25 / 24)
    assert found.correlation > 0.95 and found.sureness > 8 and found.rival is None


def test_one_smooth_gesture_does_not_tell_when_a_film_began(surveyed):
    """Any two pieces of it that rise are alike: at wrong offsets they correlate by 0.99."""

    def one_side(at):
        return 1 + np.sin(1.5 * at)

    def other_side(at):
        return 2 + np.sin(1.2 * at + 0.3) + 0.3 * at

    one = surveyed(one_side, 20, 2)
    for other in (surveyed(other_side, 20, 2, begin=0.5), surveyed(other_side, 2, 1.5)):
        with pytest.raises(DevrfError, match=r"^b\.mp4: what moves in it does not tell .* chance"):
            timeline(PATHS, [one, other], 10)


def test_motion_that_repeats_is_refused_with_both_offsets(surveyed):
    def walk(at):
        return 1 + np.sin(2 * np.pi * at)

    one, other = surveyed(walk, 30, 8), surveyed(walk, 30, 8, begin=0.3)
    with pytest.raises(DevrfError, match=r"repeats: it began \+0\.30 or [+-]\d\.[37]0 s after a"):
        timeline(PATHS, [one, other], 10)


def test_films_of_an_hour_are_aligned(surveyed):
    generator = np.random.default_rng(1)
    times = generator.uniform(0, 3600, 2000)

    def motion(at):
        return (
            0.1 + (np.abs(at[:, None] - times[np.searchsorted(times, at) % 2000, None]) < 1)[:, 0]
        )

    times.sort()
    found = offset_between(surveyed(motion, 25, 3600), surveyed(motion, 25, 3300, begin=123.4))
    assert found.seconds == pytest.approx(123.4, abs=0.02)


def test_times_are_those_of_the_slower_video_in_the_common_part(surveyed):
    surveys = [surveyed(bursts(), 30, 6), surveyed(bursts(), 15, 6, begin=1.0)]
    clock = timeline(PATHS, surveys, 50, offsets=[0, 1])
    # 1.0 s to the first video's last frame at 179/30 s: 75 frames of the second, every other one.
    assert clock.positions[1] == tuple(range(0, 75, 2))
    assert clock.positions[0] == tuple(range(30, 180, 4))
    assert clock.times[0] == 0 and clock.times[-1] == 1
    assert np.allclose(np.diff(clock.times), 1 / 37)


def test_what_cannot_be_aligned_is_refused(surveyed):
    one, still = surveyed(bursts(), 30, 8), surveyed(np.zeros_like, 30, 8)
    noise = surveyed(lambda t: np.random.default_rng(5).uniform(0, 1, len(t)), 30, 8)
    for other, offsets in ((still, None), (noise, None), (one, [0, 5])):
        with pytest.raises(DevrfError, match=r"^b\.mp4: "):
            timeline(PATHS, [one, other], 10, offsets)


def test_times_that_no_video_has_are_refused(surveyed):
    one = surveyed(bursts(), 30, 8)
    jump = replace(one, times=(*one.times[:-1], 1e9))
    with pytest.raises(
        DevrfError, match=r"^b\.mp4: 1000000000 s of it are too many to compare; give"
    ):
        timeline(PATHS, [one, jump], 10)


# Images and their alpha masks.


def mask(level, size=SIZE):
    """A mask whose left half is white, the rest of a grey level."""
    grey = np.full(size[::-1], level, np.uint8)
    grey[:, : size[0] // 2] = 255
    return grey


@pytest.fixture
def walk(film, textured):
    """A video of four frames."""
    return film("walk.mp4", [textured(k) for k in range(4)])


@pytest.fixture
def masks(tmp_path):
    """The masks of its frames, each with another level on the right."""
    folder = tmp_path / "masks" / "walk"
    folder.mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), mask(k))
    return folder.parent


def written(footage, into, size=SIZE):
    """The images (H, W, 4) RGBA that are written of some footage."""
    paths = list(write_frames(into, footage, size, SIZE))
    return [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]


def test_masks_of_a_video_are_a_folder_or_a_video(walk, masks, tmp_path, film):
    folder = masks_of(masks, walk, 4)
    one, other = written(Chosen(walk, "static", (1, 3), folder), tmp_path / "images")
    assert (one[..., 3] == mask(1)).all() and (other[..., 3] == mask(3)).all()
    small = written(Chosen(walk, "static", (2,), folder), tmp_path / "images", (32, 24))[0]
    assert small.shape == (24, 32, 4) and (small[:, :15, 3] == 255).all()
    (tmp_path / "cut").mkdir()
    film("cut/walk.mp4", [np.full((48, 64, 3), level, np.uint8) for level in (0, 80, 160, 240)])
    video = masks_of(tmp_path / "cut", walk, 4)
    shown = written(Chosen(walk, "static", (1, 3), video), tmp_path / "images")
    for image, level in zip(shown, (80, 240), strict=True):
        assert image[..., 3].astype(float).mean() == pytest.approx(level, abs=3)


def test_films_of_one_name_have_masks_of_their_own(walk, masks, tmp_path):
    left, right, top = (tmp_path / name / "walk.mp4" for name in ("left", "right", "top"))
    films = (left, right, top)
    with pytest.raises(DevrfError, match=r"masks/walk: masks of .*left/walk\.mp4 or of ") as both:
        masks_of(masks, left, 4, others=films)
    assert f"give {masks}/left/walk and {masks}/right/walk" in str(both.value)
    shutil.copytree(masks / "walk", masks / "left" / "walk")
    (masks / "right").mkdir()
    shutil.copy(walk, masks / "right" / "walk.MOV")
    found = [masks_of(masks, path, 4, others=films) for path in films]
    assert found == [masks / "left/walk", masks / "right/walk.MOV", masks / "walk"]
    with pytest.raises(DevrfError, match=r"walk\.MOV: 4 masks, but .* has 8 frames"):
        masks_of(masks, right, 8)


def test_photographs_have_masks_of_their_names(tmp_path, textured, masks):
    (tmp_path / "walk").mkdir()
    for k in (1, 3):
        cv2.imwrite(str(tmp_path / "walk" / f"{k}.jpg"), textured(k))
    folder = masks_of(masks, tmp_path / "walk", 2)
    shown = written(Chosen(tmp_path / "walk", "static", (0, 1), folder), tmp_path / "images")
    assert [int(image[0, -1, 3]) for image in shown] == [1, 3]
    (masks / "walk" / "3.png").unlink()
    with pytest.raises(DevrfError, match=r"masks/walk/3\.png: "):
        masks_of(masks, tmp_path / "walk", 2)


def test_masks_that_do_not_fit_are_refused(walk, masks, tmp_path):
    for folder, footage, count, named in (
        (tmp_path / "nowhere", walk, 4, "nowhere: "),
        (masks, Path("left.mp4"), 4, r"masks/left: .*the masks of left\.mp4 \(capture\.masks\)"),
        (masks, walk, 5, "walk: 4 masks"),
    ):
        with pytest.raises(DevrfError, match=named):
            masks_of(folder, footage, count, "capture.masks")
    cv2.imwrite(str(masks / "walk" / "2.png"), mask(0, (32, 24)))
    with pytest.raises(DevrfError, match=r"2\.png: 32x24 px"):
        written(Chosen(walk, "static", (2,), masks / "walk"), tmp_path / "images")


def test_masks_are_alpha_channels_and_labels_0_and_1_of_all_frames_together(masks, walk):
    folder = masks / "walk"
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), np.dstack([0 * np.dstack([mask(k)] * 3), mask(k)]))
    assert masks_of(masks, walk, 4) == folder
    shown = list(chosen_masks(folder, walk, [1, 3], SIZE))
    assert (shown[0] == mask(1)).all() and (shown[1] == mask(3)).all()
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), np.minimum(mask(0), k % 2))
    (one,) = chosen_masks(folder, walk, [1], SIZE)
    assert (one == mask(0)).all()
    cv2.imwrite(str(folder / "0.png"), np.minimum(mask(0), 38))
    with pytest.raises(DevrfError, match=r"walk: masks of labels 0, 1, 38, expected black"):
        list(chosen_masks(folder, walk, [1], SIZE))


def test_masks_of_what_moves_are_black_or_white_in_the_images_size(walk, masks, tmp_path):
    half = np.full((48, 64), 255, np.uint8)
    half[:, 32:] = 90
    cv2.imwrite(str(masks / "walk" / "1.png"), half)
    footage = Chosen(walk, "static", (1,), motion=masks / "walk")
    written(footage, tmp_path / "images", (32, 24))
    (mask,) = motion_masks(tmp_path / "images", footage).values()
    assert mask.shape == (24, 32) and (mask[:, :16] == 255).all() and (mask[:, 16:] == 0).all()


def test_frames_are_cropped_to_common_proportions_and_shrunk(textured):
    a, b = PATHS
    assert common_size({a: (1920, 1080), b: (1280, 720)}, 960) == (960, 540)
    with pytest.raises(DevrfError, match=r"^b\.mp4: 720x1280 px"):
        common_size({a: (1920, 1080), b: (720, 1280)}, 960)
    picture = textured(0)
    assert (fitted(picture, (48, 48)) == picture[:, 8:56]).all()
    assert fitted(picture, (32, 24)).shape == (24, 32, 3)


# Structure from motion.

MOVING = Chosen(Path("walk.mp4"), "static", (0, 10, 20, 30))


def model(folder, *names, turned=()):
    """A model of cameras in a row; the ``turned`` ones by half a turn about y."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("# cameras\n1 SIMPLE_PINHOLE 64 48 50 32 24\n")
    (folder / "points3D.txt").touch()
    turns = ["0 0 1 0" if k in turned else "1 0 0 0" for k in range(len(names))]
    lines = [f"{k + 1} {turns[k]} 0 0 {k} 1 {name}\n\n" for k, name in enumerate(names)]
    (folder / "images.txt").write_text("".join(lines))
    return folder


def test_sequential_matching_leaves_out_what_is_far_in_order():
    moving, fixed = [str(k) for k in range(30)], ["a", "b"]
    assert len(pairs(moving, fixed, "exhaustive")) == 32 * 31 / 2
    chosen = set(pairs(moving, fixed, "sequential"))
    assert {("0", "10"), ("0", "20"), ("29", "a"), ("a", "b")} <= chosen
    assert ("0", "11") not in chosen and ("0", "21") not in chosen


def test_a_model_that_does_not_hold_the_scene_is_refused(tmp_path):
    fixed = {"view1/00003.png": Path("left.mp4")}
    folder = model(tmp_path / "whole", *MOVING.names, *fixed)
    assert len(checked_model(folder, MOVING, fixed).images) == 5
    with pytest.raises(DevrfError, match=r"^right\.mp4: "):
        checked_model(folder, MOVING, {**fixed, "view2/00000.png": Path("right.mp4")})
    folder = model(tmp_path / "few", *MOVING.names[:2], *fixed)
    with pytest.raises(
        DevrfError, match=r"^walk\.mp4: .* 2 of 4 frames only, it broke from"
    ) as few:
        checked_model(folder, MOVING, {})
    assert all(Path(name).stem in str(few.value) for name in MOVING.names[2:])


def test_cameras_that_jump_within_a_video_are_refused(tmp_path):
    moving = Chosen(Path("walk.mp4"), "static", tuple(range(6)))
    folder = model(tmp_path / "model", *moving.names, turned=(4, 5))
    with pytest.raises(DevrfError, match=r"walk\.mp4: between 00003 and 00004"):
        checked_model(folder, moving, {})
    (tmp_path / "photographs").mkdir()
    photographs = Chosen(tmp_path / "photographs", "static", tuple(range(6)))
    assert len(checked_model(folder, photographs, {}).images) == 6


def test_masks_of_many_photographs_are_listed_once(tmp_path, monkeypatch):
    for folder in ("walk", "masks/walk"):
        (tmp_path / folder).mkdir(parents=True)
        for number in range(20):
            (tmp_path / folder / f"{number}.png").touch()
    listed = []
    monkeypatch.setattr(images, "listed_images", lambda path: listed.append(path) or list_of(path))
    assert masks_of(tmp_path / "masks", tmp_path / "walk", 20) == tmp_path / "masks/walk"
    assert len(listed) == 2

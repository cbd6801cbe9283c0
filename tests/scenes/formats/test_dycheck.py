"""DyCheck's layout: splits, times, and what is scored."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.geometry.cameras import Distortion
from devrf.scenes.formats.dycheck import DycheckReader
from devrf.scenes.lens import Lens
from layouts import write_camera

# Not square. Camera 0 goes half around, cameras 1 and 2 stand and take every third moment.
WIDTH, HEIGHT, MOMENTS = 40, 32, 9
LENS = Lens((44.0, 44.0), (21.0, 15.0))
HELD_OUT = [(camera, time) for camera in (1, 2) for time in (0, 3, 6)]


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, DycheckReader, downscale=1)


def put(file: Path, content: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def split(shots: list[tuple[int, int]]) -> dict[str, Any]:
    return {
        "frame_names": [f"{camera}_{time:05d}" for camera, time in shots],
        "time_ids": [time for _, time in shots],
    }


@pytest.fixture
def folder(tmp_path, ring_cameras, picture) -> Path:
    """The balls from 15 places: nine of a moving camera, two of cameras that stand."""
    root = tmp_path / "windmill"
    ring = ring_cameras(2 * MOMENTS, width=WIDTH, height=HEIGHT, angle=0.9)
    learned = [(0, time) for time in range(MOMENTS)]
    for camera, time in learned + HELD_OUT:
        pose = ring.camera_to_world[time if camera == 0 else MOMENTS + 3 * camera]
        pixels = picture(pose, LENS, WIDTH, HEIGHT)
        placed = torch.cat([pose[:, :3], 2 * pose[:, 3:] + 1], dim=1)
        write_camera(root, "1x", f"{camera}_{time:05d}", pixels, placed, LENS)
    put(root / "splits/train.json", split(learned))
    put(root / "splits/val.json", split(HELD_OUT))
    put(root / "scene.json", {"center": [1, 1, 1], "scale": 0.5, "near": 0.5, "far": 9.0})
    return root


def test_one_camera_is_learned_from_and_the_others_are_held_out(
    folder, balls_are_where_they_project
):
    scene = DycheckReader(folder, downscale=1).read()
    train, test = scene.dynamic.train, scene.dynamic.test
    for views in (train, test):
        balls_are_where_they_project(views)
    torch.testing.assert_close(train.times, torch.arange(9) / 8)
    torch.testing.assert_close(test.times, torch.tensor([0, 3, 6] * 2) / 8)
    assert train.view.tolist() == list(range(9)) and test.view.tolist() == [0] * 3 + [1] * 3
    assert [Path(name).stem for name in test.names[:2]] == ["1_00000", "1_00003"]
    # scene.json: (position − center) · scale; the ring's own distance.
    torch.testing.assert_close(train.cameras.positions.norm(dim=1), torch.full((9,), 4.0))
    assert (scene.bounds.near, scene.bounds.far, scene.name) == (0.5, 9.0, "windmill")
    assert scene.static.train is train and test.valid_mask is None


def test_what_training_has_hardly_seen_is_not_scored(folder):
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 4] = 0
    place = folder / "covisible/1x/val"
    place.mkdir(parents=True)
    iio.imwrite(place / "1_00003.png", mask)
    scene = DycheckReader(folder, downscale=2).read()
    assert scene.dynamic.train.valid_mask is None
    valid = scene.dynamic.test.valid_mask
    assert valid is not None and valid.shape == (6, HEIGHT // 2, WIDTH // 2)
    assert valid[[0, 2, 3, 4, 5]].all()
    assert not valid[1, :, : WIDTH // 8].any() and valid[1, :, WIDTH // 8 :].all()
    whole = DycheckReader(folder, downscale=2, masks="none").read()
    assert whole.dynamic.test.valid_mask is None


def test_a_capture_by_one_camera_holds_out_every_nth(folder, caplog):
    put(folder / "splits/val.json", split([]))
    with caplog.at_level(logging.INFO):
        scene = DycheckReader(folder, downscale=1, holdout=4).read()
    assert "val.json lists no image: one of 4 training images is held out" in caplog.text
    assert [Path(name).stem for name in scene.dynamic.test.names] == ["0_00003", "0_00007"]


def test_key_points_are_shares_of_the_sides_of_the_images_that_have_them(folder):
    assert DycheckReader(folder, downscale=1).read().dynamic.keypoints is None
    place = folder / "keypoint/2x/train"
    put(place / "0_00002.json", [[10, 4, 1], [5, 8, 0]])
    put(place / "0_00007.json", [[20, 16, 1], [0, 0, 1]])
    put(place / "skeleton.json", {"name": "unnamed"})
    keypoints = DycheckReader(folder, downscale=1).read().dynamic.keypoints
    assert keypoints.shape == (9, 2, 3)
    shares = torch.tensor([[[0.5, 0.25, 1], [0.25, 0.5, 0]], [[1, 1, 1], [0, 0, 1]]])
    torch.testing.assert_close(keypoints[[2, 7]], shares)
    assert not keypoints[[0, 1, 3, 4, 5, 6, 8]].any()


def test_key_points_are_undistorted_as_the_images_are(folder, lens_directions):
    """A point in the middle of a pixel is where a pinhole sees what the lens sees there."""
    lens = Lens((44.0, 46.2), (21.0, 15.0), Distortion((-0.3, 0.1, 0.01, 0.0), (0.006, -0.008)))
    file = folder / "camera/0_00002.json"
    camera = json.loads(file.read_text())
    radial, tangential = [-0.3, 0.1, 0.01], [0.006, -0.008]
    bent = {"radial_distortion": radial, "tangential": tangential, "pixel_aspect_ratio": 1.05}
    put(file, camera | bent)
    put(folder / "keypoint/2x/train/0_00002.json", [[1.25, 1.75, 1], [18.25, 14.25, 0]])
    dynamic = DycheckReader(folder, downscale=1).read().dynamic
    views = dynamic.train.single(2)
    seen = lens_directions(lens, WIDTH, HEIGHT)[[3, 28], [2, 36]]
    pixels = views.cameras.focal * seen + views.cameras.center
    assert dynamic.keypoints is not None
    shares = pixels / views.cameras.extents
    torch.testing.assert_close(dynamic.keypoints[2, :, :2], shares.float(), rtol=0, atol=1e-5)
    assert float((shares * 20 - torch.tensor([1.25, 1.75])).abs().max()) > 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: (root / "splits/val.json").unlink(), "splits/val.json: no such file; it"),
        (
            lambda root: put(root / "splits/val.json", split([(0, 4)])),
            "val.json: lists '0_00004', as splits/train.json does; list it in one of them",
        ),
        (
            lambda root: put(
                root / "splits/train.json", {**split([(0, 1), (0, 2)]), "time_ids": [1]}
            ),
            "train.json: 2 frame_names, but 1 time_ids",
        ),
        (
            lambda root: [
                put(root / f"keypoint/2x/train/0_0000{k}.json", [[1, 2, 1]] * (1 + k))
                for k in (0, 3)
            ],
            "0_00003.json: 4 key points, but others have another number",
        ),
    ],
)
def test_what_is_wrong_is_one_line(folder, message_of, change, said):
    change(folder)
    assert said in message_of(folder)

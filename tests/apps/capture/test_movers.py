"""What moves before a moving camera, told from flow and the camera's true poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.apps.capture.movers import MonocularVideo
from devrf.scenes.sparse_model import ModelImage, SparseModel

WIDTH = 160
HEIGHT = 120
FOCAL = 150.0
COUNT = 9
# By so many pixels a frame the wall goes left as the camera goes right, and the patch goes down.
STEP = 3


def pattern(seed, height, width):
    """(height, width, 3) uint8, smooth enough for flow."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def filmed(tmp_path):
    """Films a wall at distance 1, before it a patch that goes down; its names and its model."""

    def film(patch):
        wall = pattern(0, HEIGHT, WIDTH + STEP * COUNT)
        thing = pattern(1, 50, 60)
        images = []
        for k in range(COUNT):
            picture = wall[:, STEP * k : STEP * k + WIDTH].copy()
            if patch:
                picture[20 + STEP * k : 70 + STEP * k, 50:110] = thing
            name = f"{k}.png"
            cv2.imwrite(str(tmp_path / name), picture)
            to_camera = np.column_stack([np.eye(3), [-STEP * k / FOCAL, 0.0, 0.0]])
            images.append(ModelImage(name, 1, to_camera, np.zeros(0, np.int64)))
        lens = {"fl_x": FOCAL, "fl_y": FOCAL, "w": WIDTH, "h": HEIGHT, "cx": 80.0, "cy": 60.0}
        points = np.zeros((0, 3))
        model = SparseModel(Path(), {1: lens}, tuple(images), points, np.zeros(0, np.int64))
        return MonocularVideo(tmp_path, [image.name for image in images]), model

    return film


def test_what_leaves_its_epipolar_lines_is_masked(filmed):
    film, model = filmed(patch=True)
    masks = film.motion_masks(model)
    middle = masks["4.png"]
    assert middle.shape == (HEIGHT, WIDTH) and set(np.unique(middle)) == {0, 255}
    inside = middle[20 + STEP * 4 : 70 + STEP * 4, 50:110]
    assert (inside == 0).mean() > 0.9
    assert (middle[:, 125:] == 255).mean() > 0.95


def test_where_nothing_moves_there_are_no_masks(filmed):
    film, model = filmed(patch=False)
    assert film.motion_masks(model) == {}


@pytest.mark.parametrize(("placed", "masked"), [(1, 0), (2, 0), (3, 3)])
def test_images_too_few_to_compare_are_not_masked(filmed, placed, masked):
    film, model = filmed(patch=True)
    few = replace(model, images=model.images[:placed])
    assert len(film.motion_masks(few)) == masked


def test_what_stands_still_tells_which_cameras_are_right(filmed):
    film, model = filmed(patch=True)
    masks = film.motion_masks(model)

    def risen_by(height):
        return height * np.outer([0, 1, 0], [0, 0, 0, 1])

    # Cameras that rise as the patch goes down explain it, and nothing else.
    risen = replace(
        model,
        images=tuple(
            replace(image, to_camera=image.to_camera + risen_by(STEP * k / FOCAL))
            for k, image in enumerate(model.images)
        ),
    )
    assert film.static_error(model, masks) < 0.1
    assert film.static_error(risen, masks) > 1.0

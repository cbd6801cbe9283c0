"""The world of a sparse model: which space holds what its cameras see."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from devrf.scenes.sparse_model import (
    AROUND,
    LEFT_OUT,
    LEFT_OUT_OF_VIDEO,
    ModelImage,
    SparseModel,
    ndc_holds,
    normalised,
)
from layouts import points_in


def model(places, turns=(0.0,)):
    """Cameras that look along z, turned about y by degrees, 100 points at 4 to 5 before them."""
    points = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 5], (100, 3))
    images = []
    for k, place in enumerate(places):
        angle = math.radians(turns[k % len(turns)])
        cosine = math.cos(angle)
        sine = math.sin(angle)
        turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        to_camera = np.column_stack([turn, -turn @ np.array(place)])
        images.append(ModelImage(f"{k}.png", 1, to_camera, np.arange(100)))
    lens = {"fl_x": 100.0, "fl_y": 100.0, "w": 100, "h": 100, "cx": 50.0, "cy": 50.0}
    return SparseModel(Path("sparse"), {1: lens}, tuple(images), points, np.arange(100))


NEAR_ONE_ANOTHER = [(-0.5, 0, 0), (0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0)]


def test_cameras_near_one_another_that_look_one_way_share_ndc():
    # The nearest point is at 4, the plane at 3, which cameras 1 apart see 1 / 3 wider than one.
    assert ndc_holds(model(NEAR_ONE_ANOTHER))
    assert normalised(model(NEAR_ONE_ANOTHER))[1].space == "ndc"


@pytest.mark.parametrize(
    "scattered",
    [
        model([(-3, 0, 0), (3, 0, 0), (0, 1, 0)]),  # their views are 3 wide on the plane
        model(NEAR_ONE_ANOTHER, turns=(-30, 30)),  # within 45 degrees, but wider than a view
        model([*NEAR_ONE_ANOTHER, (0, 0, 5)]),  # one is before the plane
    ],
)
def test_hand_held_cameras_share_contraction_around_their_points(scattered):
    assert not ndc_holds(scattered)
    poses, bounds = normalised(scattered, "inward")
    assert bounds.space == "contracted" and bounds.box is not None
    distances = poses[:, :, 3].norm(dim=1)
    assert float(distances.median()) == pytest.approx(AROUND)
    points = points_in(poses, scattered)
    assert float(points.median(dim=0).values.norm()) < 0.1  # of other axes
    low, high = (np.array(corner) for corner in bounds.box)
    inside = ((points.numpy() > low) & (points.numpy() < high)).all(axis=1)
    assert inside.mean() > 0.8


@pytest.mark.parametrize("left_out", [LEFT_OUT, LEFT_OUT_OF_VIDEO])
def test_the_inner_box_leaves_out_points_at_each_face(left_out):
    scattered = model(NEAR_ONE_ANOTHER, turns=(-30, 30))
    poses, bounds = normalised(scattered, "inward", left_out=left_out)
    low, high = (np.array(corner) for corner in bounds.box)
    margin = (high - low) / 12  # a tenth of what is between, on both sides
    points = points_in(poses, scattered)
    around = points[points.norm(dim=1) < AROUND].numpy()
    for beyond in (around < low + margin, around > high - margin):
        assert beyond.mean(axis=0) * 100 == pytest.approx(left_out, abs=100 / len(around))

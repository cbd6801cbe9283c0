"""Scenes of smaller images."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.reduced import reduced


def test_sides_keep_their_proportion_and_cameras_their_rays(tiny_scene):
    small = reduced(tiny_scene, 12)
    train, before = small.static.train, tiny_scene.static.train
    assert (train.width, train.height) == (12, 9) and (before.width, before.height) == (24, 18)
    assert (train.cameras.width, train.cameras.height) == (12, 9)
    # The middle of an image, and what was one of its quarters' corners, are where they were.
    camera = torch.zeros(2, dtype=torch.int64)
    rays = train.cameras.rays(camera, torch.tensor([[6.0, 4.5], [3.0, 2.25]]))
    expected = before.cameras.rays(camera, torch.tensor([[12.0, 9.0], [6.0, 4.5]]))
    torch.testing.assert_close(rays.directions, expected.directions)
    assert small.bounds == tiny_scene.bounds and len(train) == len(before)
    assert small.clock == tiny_scene.clock and train.names == before.names


def test_pixels_are_means_flow_is_in_the_smaller_pixels(tiny_scene):
    small = reduced(tiny_scene, 12).dynamic.train
    whole = tiny_scene.dynamic.train
    opaque = (whole.pixels[..., 3].view(-1, 9, 2, 12, 2) == 255).all(dim=4).all(dim=2)
    means = whole.pixels[..., :3].float().view(-1, 9, 2, 12, 2, 3).mean(dim=(2, 4))
    assert (small.pixels[..., :3][opaque] - means[opaque]).abs().max() <= 1
    assert whole.flow is not None and small.flow is not None
    valid = whole.flow.valid.view(-1, 9, 2, 12, 2).all(dim=4).all(dim=2)
    vectors = whole.flow.vectors.view(-1, 9, 2, 12, 2, 2).mean(dim=(2, 4)) / 2
    torch.testing.assert_close(small.flow.vectors[valid], vectors[valid])
    assert valid.any() and small.flow.valid[valid].all()


def test_a_forward_facing_scene_is_seen_by_the_same_space(tiny_toy):
    small = reduced(tiny_toy, 12)
    before, after = tiny_toy.space, small.space
    assert isinstance(before, NormalizedDevice) and isinstance(after, NormalizedDevice)
    assert (after.width, after.height, after.near) == (12, 9, before.near)
    assert after.slopes == pytest.approx(before.slopes)


def test_small_images_and_a_film_stay_as_they_are(tiny_scene, four_frame_scene):
    small = reduced(tiny_scene, 24)
    assert small.static.train.pixels is tiny_scene.static.train.pixels
    # Nothing is smaller than what readers take.
    assert reduced(tiny_scene, 4).static.train.pixels.shape[1:3] == (8, 8)
    film = reduced(replace(tiny_scene, dynamic=tiny_scene.static), 12)
    assert film.dynamic.train is film.static.train

"""Held-out views: what their truth is, and that scores compare like with like."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from devrf.evaluation.held_out import exposed, score, truth_image
from devrf.evaluation.scoring import score_held_out
from devrf.evaluation.suite import MetricSuite
from devrf.metrics.image import psnr, ssim
from devrf.rendering.renderer import Renderer
from devrf.system.progress import followed
from pictures import plain_picture


def test_truth_by_hand(tiny_scene):
    pixels = torch.tensor([[[[255, 0, 102, 51], [7, 7, 7, 0]]]], dtype=torch.uint8)
    views = replace(tiny_scene.dynamic.test, pixels=pixels)
    # alpha 0.2 on white: 0.8 + 0.2 · colour.
    expected = torch.tensor([[[1.0, 0.8, 0.88], [1.0, 1.0, 1.0]]])
    torch.testing.assert_close(truth_image(views, 0, "white"), expected)
    expected = torch.tensor([[[0.2, 0.0, 0.08], [0.0, 0.0, 0.0]]])
    torch.testing.assert_close(truth_image(views, 0, "black"), expected)
    opaque = replace(views, pixels=pixels[..., :3])
    torch.testing.assert_close(truth_image(opaque, 0, "white")[0, 0, 2], torch.tensor(0.4))


def test_only_pixels_that_count_are_scored(learned, tiny_scene):
    views, renderer = tiny_scene.dynamic.test, Renderer(learned[0].scene_model)
    valid_mask = torch.ones(len(views), 18, 24, dtype=torch.bool)
    whole = score(renderer, views, 1, "white")
    same = score(renderer, replace(views, valid_mask=valid_mask), 1, "white")
    assert same.scores == pytest.approx(whole.scores)
    valid_mask[:, :, 16:] = False
    some = score(renderer, replace(views, valid_mask=valid_mask), 1, "white")
    seen, truth = whole.prediction[:, :16], whole.truth[:, :16]
    assert some.psnr == some.rest_pose_psnr == pytest.approx(psnr(seen, truth))
    assert some.ssim == pytest.approx(ssim(seen, truth), abs=1e-6)
    # What is shown is what was seen; what it is compared by is right where nothing counts.
    assert torch.equal(some.prediction, whole.prediction)
    assert torch.equal(some.compared[:, 16:], whole.truth[:, 16:])
    # Too narrow for a window, or only the image's rim.
    valid_mask[:, :, 8:] = False
    assert -1 <= score(renderer, replace(views, valid_mask=valid_mask), 1, "white").ssim <= 1
    valid_mask[:, 1:] = False
    rim = score(renderer, replace(views, valid_mask=valid_mask), 1, "white")
    assert rim.psnr == pytest.approx(psnr(whole.prediction[:1, :8], whole.truth[:1, :8]))


def test_a_score_is_that_of_the_picture_at_the_views_time(learned, tiny_scene):
    views, model = tiny_scene.dynamic.test, learned[0].scene_model
    scored = score(Renderer(model), views, 2, "white")
    assert scored.name == views.names[2] and scored.time == 1.0
    assert scored.prediction.shape == scored.truth.shape == (18, 24, 3)
    seen = plain_picture(model, views.cameras.image_rays(2), 1.0, torch.ones(3)).color.clamp(0, 1)
    torch.testing.assert_close(scored.prediction, seen.view(18, 24, 3))
    assert scored.psnr == pytest.approx(psnr(scored.prediction, scored.truth))
    assert scored.ssim == pytest.approx(ssim(scored.prediction, scored.truth))
    # Without a deformation the rest pose is all that can be shown.
    assert scored.rest_pose_psnr == scored.psnr


def test_static_views_are_scored_at_rest_whatever_their_time(moving, tiny_scene):
    views, renderer = tiny_scene.dynamic.test, Renderer(moving)
    moved, rest = (score(renderer, views, 2, "white", time=time) for time in (None, 0.0))
    assert (moved.time, rest.time) == (1.0, 1.0)
    assert rest.psnr == rest.rest_pose_psnr == moved.rest_pose_psnr != moved.psnr


def test_scoring_says_how_far_it_is(learned, tiny_scene, caplog, monkeypatch):
    monkeypatch.setattr(
        "devrf.evaluation.scoring.followed", partial(followed, line_every_seconds=0.0)
    )
    caplog.set_level(logging.INFO, logger="devrf")
    views = tiny_scene.dynamic.test
    scored = score_held_out(learned[0].scene_model, {"dynamic": views}, "white")["dynamic"]
    assert [view.name for view in scored] == list(views.names) and len(views) > 2
    said = [line.rpartition(", ")[0] for line in caplog.messages]
    assert said == [f"held-out images, dynamic: {k} of {len(views)}" for k in range(1, len(views))]


def test_half_an_image_tells_its_exposure(learned, tiny_scene):
    renderer, views = Renderer(learned[0].scene_model), tiny_scene.dynamic.test
    seen = score(renderer, views, 1, "white").prediction
    gain = torch.tensor([0.5, 0.6, 0.7])
    left = torch.zeros(len(views), 18, 24, dtype=torch.bool)
    left[:, :, :12] = True
    pixels = (seen * gain * 255).round().to(torch.uint8).expand(len(views), 18, 24, 3)
    dark = replace(views, pixels=pixels, valid_mask=~left)
    assert score(renderer, dark, 1, "white").psnr < 15
    told = score(renderer, replace(dark, exposure_mask=left), 1, "white")
    torch.testing.assert_close(told.prediction, seen * gain, atol=0.01, rtol=0)
    assert told.psnr > 45
    # Nothing tells it: as it is.
    mute = score(renderer, replace(dark, exposure_mask=left & False), 1, "white")
    assert torch.equal(mute.prediction, seen)


def test_what_is_too_bright_does_not_tell_the_exposure():
    prediction = torch.rand(18, 24, 3, generator=torch.Generator().manual_seed(0))
    truth = (1.5 * prediction).clamp(max=1)
    assert float((truth == 1).float().mean()) > 0.2
    told = torch.ones(1, 18, 24, dtype=torch.bool)
    views = SimpleNamespace(exposure_mask=told)
    torch.testing.assert_close(exposed(prediction, truth, views, 0), truth)
    # An empty picture is not made as bright as the truth.
    assert float(exposed(1e-4 + 0 * truth, truth, views, 0).max()) < 1e-3


def test_images_of_two_sizes_are_scored_each_at_its_own(moving, tiny_scene, two_sizes):
    renderer = Renderer(moving)
    suite = MetricSuite(("ms_ssim", "psnr_masked", "depth_error"))
    views, whole = two_sizes.dynamic.test, tiny_scene.dynamic.test
    for index, (width, height) in enumerate([(18, 18), (24, 16), (18, 18)]):
        seen = score(renderer, views, index, "white", suite)
        full = score(renderer, whole, index, "white", suite)
        prediction, truth = (image[:height, :width] for image in (full.prediction, full.truth))
        assert torch.equal(seen.truth, truth)
        torch.testing.assert_close(seen.prediction, prediction, atol=1e-5, rtol=0)
        assert seen.prediction.shape == seen.compared.shape == (height, width, 3)
        assert seen.depth.shape == seen.opacity.shape == (height, width)
        assert seen.psnr == pytest.approx(psnr(prediction, truth), abs=1e-3)
        assert seen.ssim == pytest.approx(ssim(prediction, truth), abs=1e-5)
        inside = whole.pixels[index, :height, :width, 3] > 127
        masked = float((prediction - truth)[inside].square().mean())
        assert seen.further["psnr_masked"] == pytest.approx(-10 * math.log10(masked), abs=1e-3)
        assert (seen.further["depth_error"] is None) == (full.further["depth_error"] is None)

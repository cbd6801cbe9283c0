"""Held-out views: what their truth is, and that scores compare like with like."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest
import torch
from lightning import Trainer

from devrf.metrics.image import psnr, ssim
from devrf.scenes.scene import Scene
from devrf.stages.canonical import CanonicalStage
from devrf.stages.held_out import background_value, score, truth_image


@pytest.mark.parametrize(("name", "value"), [("white", 1.0), ("black", 0.0), ("random", 1.0)])
def test_backgrounds_of_held_out_views(
    name: Literal["white", "black", "random"], value: float
) -> None:
    assert background_value(name) == value


def test_truth_by_hand(tiny_scene: Scene) -> None:
    pixels = torch.tensor([[[[255, 0, 102, 51], [7, 7, 7, 0]]]], dtype=torch.uint8)
    views = replace(tiny_scene.dynamic.test, pixels=pixels)
    # alpha 0.2 on white: 0.8 + 0.2 · colour.
    expected = torch.tensor([[[1.0, 0.8, 0.88], [1.0, 1.0, 1.0]]])
    torch.testing.assert_close(truth_image(views, 0, "white"), expected)
    expected = torch.tensor([[[0.2, 0.0, 0.08], [0.0, 0.0, 0.0]]])
    torch.testing.assert_close(truth_image(views, 0, "black"), expected)
    opaque = replace(views, pixels=pixels[..., :3])
    torch.testing.assert_close(truth_image(opaque, 0, "white")[0, 0, 2], torch.tensor(0.4))


def test_a_score_is_that_of_the_picture_at_the_views_time(
    learned: tuple[CanonicalStage, Trainer], tiny_scene: Scene
) -> None:
    views, model = tiny_scene.dynamic.test, learned[0].model
    scored = score(model, views, 2, "white", torch.device("cpu"))
    assert scored.name == views.names[2] and scored.time == 1.0
    assert scored.prediction.shape == scored.truth.shape == (18, 24, 3)
    seen = model.picture(views.cameras.image_rays(2), 1.0, torch.ones(3)).color.clamp(0, 1)
    torch.testing.assert_close(scored.prediction, seen.view(18, 24, 3))
    assert scored.psnr == pytest.approx(psnr(scored.prediction, scored.truth))
    assert scored.ssim == pytest.approx(ssim(scored.prediction, scored.truth))
    # Without a deformation the rest pose is all that can be shown.
    assert scored.rest_pose_psnr == scored.psnr

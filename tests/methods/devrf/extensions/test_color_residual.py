"""Colours that change over time: the residual A_t, and how the deformation stage learns it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.color_decoder import ColorDecoder, SigmoidColor
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.color_residual import (
    NAME,
    ColorResidualGrid,
    LearnColorResidual,
)
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import DEFORMATION_LOSS, VisitSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, Views

SHORT = DeformationSchedule(levels=(Level(4, 6), Level(6, 6)), rays=128)
TINY = DeformationSchedule(levels=(Level(4, 1), Level(6, 1, lr_factor=0.25)), rays=16)
FAST = VisitSettings(learning_rate=5e-3, views="all", pixels="occupied")
LEARNED: dict[str, Any] = {"learn": "always", "side": 6, "start_level": 1, "learning_rate": 0.1}
CLOCK = FrameClock((0.0, 0.5, 1.0))


@pytest.fixture
def field(cube: Box) -> ColorResidualGrid:
    """A₁ is 1 in red, A₂ is 3 in red."""
    made = ColorResidualGrid(cube, CLOCK, voxels=3**3)
    made.values[1, ..., 0], made.values[2, ..., 0] = 1.0, 3.0
    return made


def test_the_residual_is_blended_between_frames_and_absent_at_rest(field):
    assert field.at(0.0) is None
    point = torch.zeros(1, 3)
    for time, red in ((0.25, 0.5), (0.5, 1.0), (0.75, 2.0), (1.0, 3.0)):
        residual = field.at(time)
        assert residual is not None
        torch.testing.assert_close(residual(point), torch.tensor([[red, 0.0, 0.0]]))


@pytest.mark.parametrize("decoder", [SigmoidColor(), ColorDecoder(3, 8)], ids=["plain", "network"])
def test_it_is_added_before_the_sigmoid(decoder):
    torch.manual_seed(0)
    features, ray = torch.randn(2, 3), torch.zeros(2, dtype=torch.long)
    rest = decoder(features, torch.eye(3)[:1], ray)
    residual = torch.tensor([[0.5, 0.0, -1.0], [0.0, 2.0, 0.0]])
    seen = decoder(features, torch.eye(3)[:1], ray, residual=residual)
    torch.testing.assert_close(torch.logit(seen) - torch.logit(rest), residual)


def stage_with(
    rest: LoadedCheckpoint,
    schedule: DeformationSchedule = TINY,
    loss: Mapping[str, float] = DEFORMATION_LOSS,
    **given: Any,
) -> DeformationStage:
    extension = {NAME: LearnColorResidual(**{**LEARNED, **given})}
    return DeformationStage(rest, schedule, FAST, loss, iterations_per_step=1, extensions=extension)


def fading(scene: Scene) -> Scene:
    """The scene standing still, its colours half as bright after the first frame."""
    views = scene.dynamic.train
    pixels = views.pixels.clone()
    for image in range(len(views)):
        same = (views.view == views.view[image]) & (views.times == 0)
        pixels[image] = views.pixels[int(same.nonzero()[0])]
        if views.times[image] > 0:
            pixels[image, ..., :3] //= 2
    train = replace(views, pixels=pixels)
    return replace(scene, dynamic=replace(scene.dynamic, train=train))


def error(model: DeVRFModel, views: Views, image: int) -> float:
    """Mean squared error on the alpha mask of an image."""
    seen = Renderer(model).view(views.cameras, image, float(views.times[image]), 1.0).color
    truth = views.pixels[image].float().view(-1, 4) / 255
    mask = truth[:, 3] > 0.99
    return float((seen.view(-1, 3)[mask] - truth[mask, :3]).square().mean())


def test_what_grows_darker_is_learned_by_the_residual(rest, serve, tiny_scene, trainer):
    scene, stage = fading(tiny_scene), stage_with(rest, SHORT)
    trainer(max_epochs=1).fit(stage, datamodule=serve(scene))
    model, views = stage.scene_model, scene.dynamic.train
    last, residual = int((views.times == 1).nonzero()[0]), model.color_residual
    assert residual is not None
    assert not residual.values[0].any() and residual.values[1:].mean() < 0
    learned = error(model, views, last)
    residual.values.zero_()
    assert learned < 0.5 * error(model, views, last)


@pytest.mark.parametrize(
    ("drift", "if_static", "first"), [(0.01, None, None), (0.1, 2, 0), (None, 2, 1)]
)
def test_auto_learns_colours_that_drift_early_and_others_late(
    rest, datamodule, trainer, monkeypatch, drift, if_static, first
):
    monkeypatch.setattr(f"{LearnColorResidual.__module__}.color_drift", lambda views: drift)
    schedule = replace(TINY, levels=(Level(4, 1), Level(6, 1, other_terms=2.0)))
    scale = {"cycle": 0.25}
    given = {"start_level_static_color": if_static, "loss_scale_if_color_drift": scale}
    stage = stage_with(rest, schedule, {"render": 1.0, "cycle": 1.0}, learn="auto", **given)
    trainer(max_steps=1).fit(stage, datamodule=datamodule)
    assert (stage.scene_model.color_residual is not None) == (first is not None)
    groups = [group["name"] for group in stage.optimizer.param_groups]
    assert groups[1:] == [NAME] * (first is not None)
    (extension,) = stage.extensions
    learned = [NAME in extension.frame_fields(stage.context, level) for level in (0, 1)]
    assert learned == [first is not None and level >= first for level in (0, 1)]
    # Where colours drift, terms count less from the level on that learns them.
    factors = [0.25, 0.5] if first == 0 else [1.0, 2.0]
    assert [stage.deformation_loss.weights_at(level)["cycle"] for level in (0, 1)] == factors


def test_its_rate_is_its_own_at_every_level(rest, datamodule, trainer):
    stage, rates = stage_with(rest), []
    watch = LambdaCallback(
        on_train_batch_end=lambda *_: rates.append(
            [float(group["lr"]) for group in stage.optimizer.param_groups]
        )
    )
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert rates[-1][0] == pytest.approx(0.25 * rates[0][0])
    assert rates[0][1] == rates[-1][1] == pytest.approx(0.1)


def test_a_checkpoint_keeps_the_colours(moving, tiny_scene):
    other = DeVRFModel.from_config(moving.config())
    other.load_stored_state(moving.stored_state())
    assert other.color_residual is not None and moving.color_residual is not None
    assert other.color_residual.clock == moving.color_residual.clock
    cameras = tiny_scene.dynamic.test.cameras
    before, after = (Renderer(model).view(cameras, 0, 0.7, 1.0).color for model in (moving, other))
    torch.testing.assert_close(after, before, atol=5e-3, rtol=0)
    other.color_residual.values.zero_()
    assert (Renderer(other).view(cameras, 0, 0.7, 1.0).color - before).abs().max() > 0.02


def test_wrong_settings_are_told(rest):
    with pytest.raises(DevrfError, match="color_residual.learn: expected never, always or auto"):
        LearnColorResidual("allways")  # type: ignore[arg-type]
    with pytest.raises(DevrfError, match="color_residual.side"):
        LearnColorResidual(side=1)
    with pytest.raises(DevrfError, match="flaw is no term of loss.deformation"):
        stage_with(rest, loss_scale_if_color_drift={"flaw": 0.1})
    with pytest.raises(DevrfError, match="loss_scale_if_color_drift.flow"):
        LearnColorResidual(loss_scale_if_color_drift={"flow": -1.0})

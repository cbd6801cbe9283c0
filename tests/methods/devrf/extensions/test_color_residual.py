"""Colours that change over time: the residual A_t, and how the deformation stage learns it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import LambdaCallback
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint, load_checkpoint, save_checkpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.canonical_field import ColorDecoder, SigmoidColor
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.color_residual import (
    NAME,
    ColorResidual,
    ResidualField,
    ResidualGrid,
)
from devrf.methods.devrf.settings import MotionSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, Views

SHORT = DeformationSchedule(levels=(Level(4, 6), Level(6, 6)), rays=128)
FAST = MotionSettings(learning_rate=5e-3, views="all", pixels="occupied")
LEARNED: dict[str, Any] = {"learn": "always", "side": 6, "start_level": 1, "learning_rate": 0.1}
CLOCK = FrameClock((0.0, 0.5, 1.0))


@pytest.fixture
def field(cube: Box) -> ResidualField:
    """A₁ is 1 in red, A₂ is 3 in red."""
    made = ResidualField(cube, CLOCK, voxels=3**3)
    made.values[1, ..., 0], made.values[2, ..., 0] = 1.0, 3.0
    return made


def test_the_residual_is_blended_between_frames_and_absent_at_rest(field: ResidualField) -> None:
    assert field.at(0.0) is None
    point = torch.zeros(1, 3)
    for time, red in ((0.25, 0.5), (0.5, 1.0), (0.75, 2.0), (1.0, 3.0)):
        residual = field.at(time)
        assert residual is not None
        torch.testing.assert_close(residual(point), torch.tensor([[red, 0.0, 0.0]]))


def test_the_residual_is_interpolated_in_space(cube: Box) -> None:
    grid = torch.zeros(3, 3, 3, 3)
    grid[1, 1, 1, 2] = 8.0
    residual = ResidualGrid(grid, cube)
    middle = torch.tensor([cube.low]) + 0.5 * torch.tensor([cube.size])
    # Half a cell away along each axis: an eighth.
    away = middle + 0.25 * torch.tensor([cube.size])
    torch.testing.assert_close(residual(torch.cat([middle, away]))[:, 2], torch.tensor([8.0, 1.0]))


@pytest.mark.parametrize("decoder", [SigmoidColor(), ColorDecoder(3, 8)], ids=["plain", "network"])
def test_it_is_added_before_the_sigmoid(decoder: torch.nn.Module) -> None:
    torch.manual_seed(0)
    features, ray = torch.randn(2, 3), torch.zeros(2, dtype=torch.long)
    rest = decoder(features, torch.eye(3)[:1], ray)
    residual = torch.tensor([[0.5, 0.0, -1.0], [0.0, 2.0, 0.0]])
    seen = decoder(features, torch.eye(3)[:1], ray, residual=residual)
    torch.testing.assert_close(torch.logit(seen) - torch.logit(rest), residual)


def stage_with(rest: LoadedCheckpoint, schedule: DeformationSchedule = SHORT, **given: Any) -> Any:
    extension = ColorResidual(**{**LEARNED, **given})
    extensions = {NAME: extension}
    return DeformationStage(rest, schedule, FAST, iterations_per_step=1, extensions=extensions)


def noted(
    trainer: Callable[..., Trainer], stage: Any, data: SceneDataModule, what: Callable[[], Any]
) -> list[Any]:
    """What is asked after each step of fitting a stage."""
    seen: list[Any] = []
    watch = LambdaCallback(on_train_batch_end=lambda *_: seen.append(what()))
    trainer(watch, max_epochs=1).fit(stage, datamodule=data)
    return seen


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


def error(model: object, views: Views, image: int) -> float:
    """Mean squared error on the alpha mask of an image."""
    seen: Tensor = Renderer(model).view(views.cameras, image, float(views.times[image]), 1.0).color  # type: ignore[arg-type]
    truth = views.pixels[image].float().view(-1, 4) / 255
    mask = truth[:, 3] > 0.99
    return float((seen.view(-1, 3)[mask] - truth[mask, :3]).square().mean())


def test_what_grows_darker_is_learned_by_the_residual_alone(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    tiny_scene: Scene,
    trainer: Callable[..., Trainer],
) -> None:
    scene, errors = fading(tiny_scene), {}
    last = int((scene.dynamic.train.times == 1).nonzero()[0])
    for learn in ("never", "always"):
        stage = stage_with(rest, learn=learn)
        trainer(max_epochs=1).fit(stage, datamodule=type(datamodule)(scene))  # type: ignore[call-arg]
        errors[learn] = error(stage.scene_model, scene.dynamic.train, last)
    assert errors["always"] < 0.5 * errors["never"]
    assert stage.scene_model.color_residual is not None
    values = stage.scene_model.color_residual.values
    assert not values[0].any() and values[1:].mean() < 0


@pytest.mark.parametrize(
    ("drift", "if_steady", "first"),
    [
        (0.01, None, None),
        (0.1, None, 0),
        (None, 2, 1),
        (0.1, 2, 0),
    ],
)
def test_auto_learns_colours_that_drift_early_and_others_late(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
    drift: float | None,
    if_steady: int | None,
    first: int | None,
) -> None:
    monkeypatch.setattr(
        "devrf.methods.devrf.extensions.color_residual.color_drift", lambda views: drift
    )
    stage = stage_with(rest, learn="auto", start_level_static_color=if_steady)
    seen = noted(trainer, stage, datamodule, lambda: NAME in stage.active[0].further)
    model, groups = stage.scene_model, stage.optimizer.param_groups
    assert (model.color_residual is not None) == (first is not None)
    assert [group["name"] for group in groups][1:] == [NAME] * (first is not None)
    assert [seen[0], seen[-1]] == [first is not None and level >= first for level in (0, 1)]


def test_terms_count_less_at_levels_that_learn_colours_that_drift(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "devrf.methods.devrf.extensions.color_residual.color_drift", lambda views: 0.1
    )
    chosen = ColorResidual(
        "auto", side=6, start_level_static_color=2, loss_scale_if_color_drift={"cycle": 0.25}
    )
    schedule = replace(SHORT, levels=(Level(4, 6), Level(6, 6, weight_factors={"cycle": 2.0})))
    stage = DeformationStage(
        rest,
        schedule,
        FAST,
        {"render": 1.0, "cycle": 1.0},
        iterations_per_step=1,
        extensions={NAME: chosen},
    )
    seen = noted(trainer, stage, datamodule, lambda: stage.weights["cycle"])
    assert (seen[0], seen[-1]) == (1.0, 0.5)


def test_its_rate_is_its_own_at_every_level(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    slower = replace(SHORT, levels=(Level(4, 6), Level(6, 6, lr_factor=0.25)))
    stage = stage_with(rest, slower)
    first, *_, last = noted(
        trainer,
        stage,
        datamodule,
        lambda: [float(group["lr"]) for group in stage.optimizer.param_groups],
    )
    assert last[0] == pytest.approx(0.25 * first[0])
    assert first[1] == last[1] == pytest.approx(0.1)


def test_a_checkpoint_keeps_the_colours(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    tiny_scene: Scene,
    trainer: Callable[..., Trainer],
    tmp_path: object,
) -> None:
    stage, fit = stage_with(rest), trainer(max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    save_checkpoint(fit, path := tmp_path / "moving.ckpt")  # type: ignore[operator]
    loaded = load_checkpoint(path, tiny_scene).model
    assert loaded.color_residual is not None and loaded.color_residual.clock == stage.field.clock
    views = tiny_scene.dynamic.train
    before, after = (
        Renderer(model).view(views.cameras, 5, 0.75, 1.0).color
        for model in (stage.scene_model, loaded)
    )
    torch.testing.assert_close(after, before, atol=5e-3, rtol=0)
    loaded.color_residual.values.zero_()
    plain = Renderer(loaded).view(views.cameras, 5, 0.75, 1.0).color
    assert (plain - before).abs().max() > 0.02


def test_wrong_settings_are_told() -> None:
    with pytest.raises(DevrfError, match="color_residual"):
        ColorResidual(side=1)


def test_a_wrong_factor_is_told(rest: LoadedCheckpoint) -> None:
    with pytest.raises(DevrfError, match="flaw is no term of loss.deformation"):
        stage_with(rest, loss_scale_if_color_drift={"flaw": 0.1})
    with pytest.raises(DevrfError, match="loss_scale_if_color_drift.flow: expected at least 0"):
        ColorResidual(loss_scale_if_color_drift={"flow": -1.0})

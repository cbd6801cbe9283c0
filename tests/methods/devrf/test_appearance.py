"""Colours that change over time: the residual A_t, and how the deformation stage learns it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from lightning import Callback, Trainer
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint, load_checkpoint, save_checkpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.appearance import AppearanceField, AppearanceSettings, ColorResidual
from devrf.methods.devrf.appearance_learning import check_weights
from devrf.methods.devrf.color_decoder import ColorDecoder, SigmoidColor
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, Views

SHORT = DeformationSchedule(levels=(Level(4, 6), Level(6, 6)), rays=128)
FAST = MotionSettings(learning_rate=5e-3, views="all", pixels="occupied")
LEARNED = AppearanceSettings(learn="always", side=6, start_level=1, learning_rate=0.1)
CLOCK = FrameClock((0.0, 0.5, 1.0))


@pytest.fixture
def field(cube: Box) -> AppearanceField:
    """A₁ is 1 in red, A₂ is 3 in red."""
    made = AppearanceField(cube, CLOCK, voxels=3**3)
    made.values[1, ..., 0], made.values[2, ..., 0] = 1.0, 3.0
    return made


def test_the_residual_is_blended_between_frames_and_absent_at_rest(field: AppearanceField) -> None:
    assert field.at(0.0) is None
    point = torch.zeros(1, 3)
    for time, red in ((0.25, 0.5), (0.5, 1.0), (0.75, 2.0), (1.0, 3.0)):
        residual = field.at(time)
        assert residual is not None
        torch.testing.assert_close(residual(point), torch.tensor([[red, 0.0, 0.0]]))


def test_a_frame_starts_from_the_one_before_it_or_after_it(field: AppearanceField) -> None:
    field.copy_neighbours([2])
    assert torch.equal(field.values[2], field.values[1])
    field.copy_neighbours([1])
    assert not field.values[1].any() and field.values[2].any()
    field.copy_neighbours([1, 2], after=True)
    assert torch.equal(field.values[1], field.values[2]) and field.values[2].any()


def test_the_residual_is_interpolated_in_space(cube: Box) -> None:
    grid = torch.zeros(3, 3, 3, 3)
    grid[1, 1, 1, 2] = 8.0
    residual = ColorResidual(grid, cube)
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
    """Mean squared error in the matte of an image."""
    seen: Tensor = Renderer(model).view(views.cameras, image, float(views.times[image]), 1.0).color  # type: ignore[arg-type]
    truth = views.pixels[image].float().view(-1, 4) / 255
    matte = truth[:, 3] > 0.99
    return float((seen.view(-1, 3)[matte] - truth[matte, :3]).square().mean())


def test_what_grows_darker_is_learned_by_the_residual_alone(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    tiny_scene: Scene,
    trainer: Callable[..., Trainer],
) -> None:
    scene, errors = fading(tiny_scene), {}
    last = int((scene.dynamic.train.times == 1).nonzero()[0])
    for learn in ("never", "always"):
        stage = DeformationStage(rest, SHORT, FAST, appearance=replace(LEARNED, learn=learn))
        trainer(max_epochs=1).fit(stage, datamodule=type(datamodule)(scene))  # type: ignore[call-arg]
        errors[learn] = error(stage.scene_model, scene.dynamic.train, last)
    assert errors["always"] < 0.5 * errors["never"]
    assert stage.scene_model.appearance is not None
    values = stage.scene_model.appearance.values
    assert not values[0].any() and values[1:].mean() < 0


@pytest.mark.parametrize(
    ("drift", "if_steady", "first"),
    [
        (0.01, None, None),
        (0.1, None, 0),
        (None, None, None),
        (0.01, 1, 1),
        (0.1, 1, 0),
        (None, 1, 1),
    ],
)
def test_auto_learns_colours_that_drift_early_and_others_late(
    rest: LoadedCheckpoint,
    tiny_scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
    drift: float | None,
    if_steady: int | None,
    first: int | None,
) -> None:
    monkeypatch.setattr("devrf.methods.devrf.appearance_learning.color_drift", lambda views: drift)
    start = None if if_steady is None else if_steady + 1
    chosen = replace(LEARNED, learn="auto", start_level_static_color=start)
    stage = DeformationStage(rest, SHORT, FAST, appearance=chosen)
    model, groups = stage.scene_model, stage.optimizer.param_groups
    stage.appearance.setup(model, tiny_scene.clock, stage.optimizer, tiny_scene.dynamic.train)
    assert (model.appearance is not None) == (first is not None)
    assert [group["name"] for group in groups][1:] == ["appearance"] * (first is not None)
    learning = [stage.appearance.at_level(model, level) is not None for level in (0, 1)]
    assert learning == [first is not None and level >= first for level in (0, 1)]


@pytest.mark.parametrize(("drift", "last"), [(0.1, 0.5), (0.01, 2.0)])
def test_terms_count_less_at_levels_that_learn_colours_that_drift(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
    drift: float,
    last: float,
) -> None:
    monkeypatch.setattr("devrf.methods.devrf.appearance_learning.color_drift", lambda views: drift)
    chosen = AppearanceSettings(
        learn="auto", side=6, start_level_static_color=2, loss_scale_if_color_drift={"cycle": 0.25}
    )
    schedule = replace(SHORT, levels=(Level(4, 6), Level(6, 6, weight_factors={"cycle": 2.0})))
    stage = DeformationStage(
        rest,
        schedule,
        FAST,
        {"render": 1.0, "cycle": 1.0},
        iterations_per_step=1,
        appearance=chosen,
    )
    seen = []

    class Weights(Callback):
        def on_train_batch_end(self, trainer: Trainer, *of_batch: object) -> None:
            seen.append(stage.losses.weights["cycle"])

    trainer(Weights(), max_epochs=1).fit(stage, datamodule=datamodule)
    assert (seen[0], seen[-1]) == (1.0, last)


def test_a_factor_of_no_term_is_told(rest: LoadedCheckpoint) -> None:
    chosen = AppearanceSettings(loss_scale_if_color_drift={"flaw": 0.1})
    with pytest.raises(
        DevrfError, match="loss_scale_if_color_drift: flaw is no term of loss.deformatio"
    ):
        DeformationStage(rest, SHORT, FAST, appearance=chosen)


def test_its_rate_is_its_own_at_every_level(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    seen = []

    class Rates(Callback):
        def on_train_batch_end(self, trainer: Trainer, *of_batch: object) -> None:
            groups = trainer.optimizers[0].param_groups
            seen.append([float(group["lr"]) for group in groups])

    slower = replace(SHORT, levels=(Level(4, 6), Level(6, 6, lr_factor=0.25)))
    stage = DeformationStage(rest, slower, FAST, iterations_per_step=1, appearance=LEARNED)
    trainer(Rates(), max_epochs=1).fit(stage, datamodule=datamodule)
    first, *_, last = seen
    assert last[0] == pytest.approx(0.25 * first[0])
    assert first[1] == last[1] == pytest.approx(0.1)


def test_a_level_before_the_first_leaves_colours_alone(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    stage = DeformationStage(rest, SHORT, FAST, appearance=replace(LEARNED, start_level=2))
    trainer(max_steps=3).fit(stage, datamodule=datamodule)
    assert stage.scene_model.appearance is not None
    assert not stage.scene_model.appearance.values.any()


def test_a_checkpoint_keeps_the_colours(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    tiny_scene: Scene,
    trainer: Callable[..., Trainer],
    tmp_path: object,
) -> None:
    stage, fit = DeformationStage(rest, SHORT, FAST, appearance=LEARNED), trainer(max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    save_checkpoint(fit, path := tmp_path / "moving.ckpt")  # type: ignore[operator]
    loaded = load_checkpoint(path, tiny_scene).model
    assert loaded.appearance is not None and loaded.appearance.clock == stage.field.clock
    views = tiny_scene.dynamic.train
    before, after = (
        Renderer(model).view(views.cameras, 5, 0.75, 1.0).color
        for model in (stage.scene_model, loaded)
    )
    torch.testing.assert_close(after, before, atol=5e-3, rtol=0)
    loaded.appearance.values.zero_()
    plain = Renderer(loaded).view(views.cameras, 5, 0.75, 1.0).color
    assert (plain - before).abs().max() > 0.02


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"side": 1}, "schedule.appearance.side: expected at least 2, not 1"),
        ({"start_level": 0}, "schedule.appearance.start_level: expected at least 1"),
        (
            {"loss_scale_if_color_drift": {"flow": -1.0}},
            "loss_scale_if_color_drift.flow: expected at least 0",
        ),
        ({"start_level_static_color": -1}, "start_level_static_color: expected at least 1"),
        ({"learning_rate": 0.0}, "schedule.appearance.learning_rate: expected more than 0"),
    ],
)
def test_wrong_settings_are_told(wrong: dict[str, object], told: str) -> None:
    with pytest.raises(DevrfError, match=told):
        AppearanceSettings(**wrong)  # type: ignore[arg-type]


def test_an_unknown_weight_is_told() -> None:
    with pytest.raises(DevrfError, match="loss.appearance: unknown term 'tvs'; the terms are"):
        check_weights({"tvs": 1.0})

"""NSFF learns by both of its protocols, on scenes of every space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from devrf.checkpoints.checkpoint import (
    load_checkpoint,
    save_checkpoint,
)
from devrf.data.datamodule import SceneDataModule
from devrf.data.rendered import RenderedDataModule
from devrf.errors import DevrfError
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.settings import NSFFSettings
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Capture, Scene

MakeStage = Callable[..., RayStage]
Fit = Callable[..., Trainer]
DYNAMIC = ProtocolStage("dynamic", "dynamic")


@pytest.mark.parametrize(("sampling", "blend"), [("occupancy", "v"), ("stratified", "additive")])
def test_it_learns(
    sampling: Any, blend: Any, tiny: NSFFSettings, stage: MakeStage, fit: Fit
) -> None:
    settings = replace(tiny, sampling=sampling, blend=blend, hard_rays=0)
    schedule = RaySchedule(45, 64, 1e-2, 1e-3, iterations_per_step=15)
    one = stage(settings=settings, schedule=schedule, loss={"color": 1.0, "neighbours": 0.1})
    colors: list[float] = []

    class Note(Callback):
        def on_train_batch_end(self, *arguments: Any) -> None:
            colors.append(float(arguments[2]["color"]))

    fit(one, Note())
    assert len(colors) == 3 and colors[-1] < 0.8 * colors[0]


def test_every_term_is_learned_from_and_finite(
    stage: MakeStage, fit: Fit, four_frames: SceneDataModule
) -> None:
    one = stage()
    fitted = fit(one, data=four_frames)
    for name in NSFF.losses:
        assert fitted.callback_metrics[f"both/{name}"].isfinite(), name
    assert fitted.callback_metrics["both/chained"] > 0
    grown = {n for n, p in one.scene_model.named_parameters() if p.grad is not None}
    assert grown == {n for n, _ in one.scene_model.named_parameters()}


def test_batches_have_further_rays_where_something_moves(
    stage: MakeStage, fit: Fit, tiny_scene: Scene
) -> None:
    one, seen = stage(), []
    gather = one._gather

    def noted(views: Any, pixels: Any) -> Any:
        batch = gather(views, pixels)
        seen.append(len(batch.rays))
        # Images are numbered through both captures.
        static = int((batch.image < len(tiny_scene.static.train)).sum())
        assert static == 16 and bool((batch.time[batch.image < 8] == 0).all())
        return batch

    one._gather = noted  # type: ignore[method-assign]
    fit(one)
    assert seen == [36, 36, 32, 32]  # N₀ = 2


def test_dynamic_never_reads_the_static_set(
    stage: MakeStage, fit: Fit, serve: Callable[[Scene], SceneDataModule], dark_scene: Scene
) -> None:
    clean = stage(DYNAMIC)
    fit(clean)
    poisoned = stage(DYNAMIC)
    fit(poisoned, data=serve(dark_scene))
    for name, value in clean.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, poisoned.state_dict()[name])
    assert clean.scene_model.box == poisoned.scene_model.box


def test_a_killed_run_goes_on_to_the_same_weights(
    stage: MakeStage, assert_goes_on_exactly: Callable[[MakeStage], None]
) -> None:
    assert_goes_on_exactly(stage)


@pytest.mark.parametrize(
    ("where", "sampling", "precision"),
    [
        ("inward", "stratified", "float32"),
        ("forward", "stratified", "bfloat16"),
        ("forward", "occupancy", "float32"),
        ("room", "occupancy", "float32"),
    ],
)
def test_a_scene_of_any_space_is_learned_and_comes_back(
    where: str, sampling: Any, precision: Any, tiny: NSFFSettings, stage: MakeStage, fit: Fit,
    tiny_scene: Scene, facing: Scene, tiny_room: Scene, tmp_path: Path,
) -> None:  # fmt: skip
    scene = {"inward": tiny_scene, "forward": facing, "room": tiny_room}[where]
    one = stage(settings=replace(tiny, sampling=sampling, precision=precision))
    fitted = fit(one, data=RenderedDataModule(lambda: scene, None))
    save_checkpoint(fitted, tmp_path / "joint.ckpt")
    loaded = load_checkpoint(tmp_path / "joint.ckpt", scene)
    model = loaded.model
    assert isinstance(model, NSFF) and loaded.metadata.complete
    assert model.space == scene.space and model.settings == one.scene_model.settings
    assert model.fields.dynamic.reach == (1.0 if where == "forward" else 0.2)
    cameras = scene.dynamic.test.cameras
    # 0.7 lies between frames.
    seen = [Renderer(m).view(cameras, 1, 0.7, 1.0) for m in (one.scene_model, model)]
    assert torch.equal(seen[0].color, seen[1].color)
    if where != "inward":
        # The last sample stands for all that is behind it: no background shows.
        torch.testing.assert_close(seen[1].opacity, torch.ones_like(seen[1].opacity))


def test_a_scene_that_says_nothing_has_nothing_to_learn(
    stage: MakeStage, fit: Fit, tiny_scene: Scene
) -> None:
    train = replace(tiny_scene.dynamic.train, flow=None)
    mute = replace(tiny_scene, dynamic=Capture(train, tiny_scene.dynamic.test))
    with pytest.raises(DevrfError, match="ray_stage.loss: this scene has nothing for any"):
        fit(stage(DYNAMIC, loss={"flow": 1.0}), data=RenderedDataModule(lambda: mute, None))

"""Neural Volumes as a method: what it learns, keeps and refuses."""

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
from devrf.methods.neural_volumes.model import NeuralVolumes
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.procedural.recipe import ProceduralForwardScene
from devrf.scenes.scene import Capture, Scene

TINY = NeuralVolumesSettings(
    code=4, encoder_views=2, encoder_size=(16, 16), encoder_channels=(4, 4, 4), encoder_width=8,
    template_channels=(8, 8, 8), warp_side=4, warp_width=4, density_scale=10.0, step=0.2,
    hull=True, occupancy_side=8,
)  # fmt: skip
QUICK = RaySchedule(
    iterations=4,
    rays=64,
    learning_rate=1e-2,
    final_learning_rate=1e-3,
    times_per_batch=2,
    iterations_per_step=2,
)
LOSS = {"color": 1.0, "kl": 1e-5, "opacity_prior": 1e-4, "tv": 1e-4}
JOINT = ProtocolStage("joint", "both")
DYNAMIC = ProtocolStage("dynamic", "dynamic")
Trainers = Callable[..., Trainer]


def stage(step: ProtocolStage = JOINT, **options: object) -> RayStage:
    """A stage of a few iterations on tiny networks."""
    torch.manual_seed(0)
    given = {"model": NeuralVolumes(TINY), "schedule": QUICK, "loss": LOSS, "step": step, **options}
    return RayStage(**given)  # type: ignore[arg-type]


def fit(one: RayStage, trainer: Trainers, data: SceneDataModule, **options: object) -> Trainer:
    """Train a stage to its end."""
    fitted = trainer(max_epochs=1, **options)
    fitted.fit(one, datamodule=data)
    return fitted


@pytest.mark.parametrize(("warp", "hull"), [("conv", False), ("affine", True)])
def test_it_learns(warp: Any, hull: bool, trainer: Trainers, datamodule: SceneDataModule) -> None:
    torch.manual_seed(0)
    model = NeuralVolumes(replace(TINY, warp=warp, maps=2, hull=hull))
    schedule = replace(QUICK, iterations=60, rays=128, learning_rate=3e-3, iterations_per_step=20)
    one, losses = stage(model=model, schedule=schedule), []

    class Note(Callback):
        def on_train_batch_end(self, *arguments: Any) -> None:
            losses.append(float(arguments[2]["color"]))

    trainer(Note(), max_epochs=1).fit(one, datamodule=datamodule)
    assert len(losses) == 3 and losses[-1] < 0.7 * losses[0]


def test_a_frame_looks_the_same_by_its_images_and_by_its_stored_code(
    trainer: Trainers, datamodule: SceneDataModule, tiny_scene: Scene, tmp_path: Path
) -> None:
    one, path = stage(), tmp_path / "joint.ckpt"
    save_checkpoint(fit(one, trainer, datamodule), path)
    loaded = load_checkpoint(path, tiny_scene).model
    assert len(one.scene_model.images) == 3 and len(loaded.images) == 0
    cameras = tiny_scene.dynamic.test.cameras
    for time in (0.0, 0.5, 0.7, 1.0):
        seen = [Renderer(m).view(cameras, 1, time, 1.0) for m in (one.scene_model, loaded)]
        torch.testing.assert_close(seen[0].color, seen[1].color, atol=1e-6, rtol=0)
        assert Renderer(loaded).at(time).at_rest == (time == 0.0)


def test_codes_between_two_frames_are_their_blend(
    trainer: Trainers, datamodule: SceneDataModule
) -> None:
    one = stage()
    fit(one, trainer, datamodule, max_steps=1)
    first, second = (one.scene_model.code_at(time) for time in (0.0, 0.5))
    assert not torch.equal(first, second)
    torch.testing.assert_close(one.scene_model.code_at(0.125), 0.75 * first + 0.25 * second)


@pytest.mark.parametrize(("step", "moments"), [(JOINT, 3), (DYNAMIC, 2)])
def test_a_batch_has_few_moments(
    step: ProtocolStage, moments: int, trainer: Trainers, four_frames: SceneDataModule
) -> None:
    one, seen = stage(step, schedule=replace(QUICK, times_per_batch=moments, rays=60)), []
    forward = one.scene_model.forward

    def noted(batch: Any) -> Any:
        seen.append(batch.frame)
        return forward(batch)

    one.scene_model.forward = noted  # type: ignore[method-assign]
    fit(one, trainer, four_frames)
    for frames in seen:
        if step.capture == "both":
            assert (frames[:30] == 0).all()  # the static half shows frame 0
            frames = frames[30:]
        # Two moments with as many rays each, one after the other.
        assert len(frames.unique()) == 2
        assert (frames[: len(frames) // 2] == frames[0]).all()
        assert (frames[len(frames) // 2 :] == frames[-1]).all()
    assert len(torch.cat(seen).unique()) > 2


def test_dynamic_never_reads_the_static_set(
    assert_never_reads_the_static_set: Callable[[Callable[[], RayStage]], None],
) -> None:
    assert_never_reads_the_static_set(lambda: stage(DYNAMIC))


def test_a_killed_run_goes_on_to_the_same_weights(
    assert_goes_on_exactly: Callable[[Callable[[], RayStage]], None],
) -> None:
    assert_goes_on_exactly(stage)


def test_what_it_cannot_learn_from_is_refused(
    trainer: Trainers, datamodule: SceneDataModule, tiny_room: Scene, tiny_scene: Scene
) -> None:
    opaque = tiny_scene.static.train.pixels[..., :3]
    static = Capture(replace(tiny_scene.static.train, pixels=opaque), tiny_scene.static.test)
    facing = ProceduralForwardScene(
        name="plush", width=16, height=16, static_views=4, train_views=2, frames=2, supersample=1
    )
    for scene, said in (
        (tiny_room, "room is unbounded; give images with alpha masks"),
        (replace(tiny_scene, static=static), "static images of robot have no alpha masks"),
        (facing(), "plush is seen from one side"),
    ):
        with pytest.raises(DevrfError, match=said):
            fit(stage(), trainer, RenderedDataModule(lambda scene=scene: scene, None))
    with pytest.raises(DevrfError, match="expected 3 fixed training cameras .* robot has 2"):
        model = NeuralVolumes(replace(TINY, encoder_views=3))
        fit(stage(model=model), trainer, datamodule)
    with pytest.raises(
        DevrfError, match=r"ray_stage.schedule.times_per_batch: expected at least 1"
    ):
        replace(QUICK, times_per_batch=0)

"""D-NeRF's facts, and that it learns by every protocol."""

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
from devrf.engine.learner import ParallelBatch
from devrf.errors import DevrfError
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = DNeRFSettings(
    width=8, depth=2, bands=2, direction_bands=1, deformation_width=8, deformation_depth=2,
    time_bands=2, sampling="occupancy", steps=16, occupancy_side=8,
)  # fmt: skip
QUICK = RaySchedule(
    iterations=4, rays=32, learning_rate=1e-2, final_learning_rate=1e-3, iterations_per_step=2
)
JOINT = ProtocolStage("joint", "both")
Trainers = Callable[..., Trainer]


def stage(step: ProtocolStage = JOINT, **options: object) -> RayStage:
    """A stage of a few iterations on tiny networks."""
    torch.manual_seed(0)
    given = {"schedule": QUICK, "loss": {"color": 1.0}, "step": step, **options}
    return RayStage(DNeRF(TINY), **given)  # type: ignore[arg-type]


def fit(one: RayStage, trainer: Trainers, data: SceneDataModule, **options: object) -> Trainer:
    """Train a stage to its end."""
    fitted = trainer(max_epochs=1, **options)
    fitted.fit(one, datamodule=data)
    return fitted


def test_nothing_moves_at_time_zero() -> None:
    model = DNeRF(TINY)
    points = torch.rand(5, 3)
    torch.nn.init.normal_(model.deformation.output.weight)
    time = torch.tensor([0.0, 0.0, 0.5, 1.0, 0.0])
    moved = model.deformation(points, time)
    assert torch.equal(moved[[0, 1, 4]], torch.zeros(3, 3))
    assert (moved[[2, 3]].abs().sum(dim=1) > 0).all()


def test_displacements_begin_next_to_zero() -> None:
    moved = DNeRF(TINY).deformation(torch.rand(9, 3), torch.rand(9))
    assert 0 < moved.abs().max() < 1e-2


def test_the_temporal_term_of_a_deformation_without_time_is_zero(
    tiny_scene: Scene, trainer: Trainers, datamodule: SceneDataModule
) -> None:
    one = stage(loss={"color": 1.0, "temporal": 1.0})
    # The output layer is zero: no time displaces anything.
    torch.nn.init.zeros_(one.scene_model.deformation.output.weight)
    fitted = fit(one, trainer, datamodule, max_steps=1)
    assert fitted.callback_metrics["both/temporal"].item() == 0.0


@pytest.mark.parametrize("sampling", ["occupancy", "hierarchical"])
def test_it_learns(sampling: str, trainer: Trainers, datamodule: SceneDataModule) -> None:
    settings = replace(TINY, sampling=sampling, coarse=8, fine=8)
    torch.manual_seed(0)
    schedule = replace(QUICK, iterations=60, rays=128, iterations_per_step=20)
    one = RayStage(DNeRF(settings), schedule, {"color": 1.0}, JOINT)
    losses: list[float] = []

    class Note(Callback):
        def on_train_batch_end(self, *arguments: Any) -> None:
            losses.append(float(arguments[2]["loss"]))

    trainer(Note(), max_epochs=1).fit(one, datamodule=datamodule)
    assert len(losses) == 3 and losses[-1] < 0.7 * losses[0]


def test_two_stages_leave_the_canonical_part_as_it_is(
    trainer: Trainers, datamodule: SceneDataModule, tmp_path: Path, tiny_scene: Scene
) -> None:
    first = stage(ProtocolStage("canonical", "static"))
    path = tmp_path / "canonical.ckpt"
    save_checkpoint(fit(first, trainer, datamodule), path)
    rest = load_checkpoint(path, tiny_scene)
    before = {k: v.clone() for k, v in rest.model.canonical.state_dict().items()}
    moved = rest.model.deformation.output.weight.detach().clone()
    step = ProtocolStage("deformation", "dynamic", frozen=("canonical",), builds_on="canonical")
    second = stage(step, rest=rest)
    fit(second, trainer, datamodule)
    after = second.scene_model.canonical.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert not torch.equal(second.scene_model.deformation.output.weight, moved)
    assert set(second.metadata().records) == {"canonical", "deformation"}


def test_dynamic_never_reads_the_static_set(
    assert_never_reads_the_static_set: Callable[[Callable[[], RayStage]], None],
) -> None:
    assert_never_reads_the_static_set(lambda: stage(ProtocolStage("dynamic", "dynamic")))


@pytest.mark.parametrize(("share", "static"), [(0.5, 16), (0.25, 8)])
def test_a_fixed_share_of_a_joint_batch_is_static(
    share: float, static: int, trainer: Trainers, datamodule: SceneDataModule, tiny_scene: Scene
) -> None:
    one, seen = stage(static_share=share), []
    draw = one.draw

    def noted(batch: object) -> object:
        pixels = draw(batch)  # type: ignore[arg-type]
        seen.append(int((pixels.image < len(tiny_scene.static.train)).sum()))
        return pixels

    one.draw = noted  # type: ignore[assignment, method-assign]
    fit(one, trainer, datamodule)
    assert seen == [static] * 4


def test_the_curriculum_adds_frames(trainer: Trainers, four_frames: SceneDataModule) -> None:
    schedule = replace(QUICK, iterations=8, curriculum=0.99)
    one = stage(schedule=schedule)
    fit(one, trainer, four_frames, max_steps=1)
    dynamic = one.pools[1]
    assert dynamic.frames == 4
    one.iteration = 0
    assert one._shown_frames(dynamic) == 3
    one.iteration = 8
    assert one._shown_frames(dynamic) == 4


def test_a_checkpoint_shows_what_was_learned(
    trainer: Trainers, datamodule: SceneDataModule, tiny_scene: Scene, tmp_path: Path
) -> None:
    one, path = stage(), tmp_path / "joint.ckpt"
    save_checkpoint(fit(one, trainer, datamodule), path)
    loaded = load_checkpoint(path, tiny_scene)
    assert isinstance(loaded.model, DNeRF) and loaded.metadata.complete
    cameras = tiny_scene.dynamic.test.cameras
    seen = [Renderer(m).view(cameras, 1, 0.7, 1.0) for m in (one.scene_model, loaded.model)]
    assert torch.equal(seen[0].color, seen[1].color)


def test_a_killed_run_goes_on_to_the_same_weights(
    assert_goes_on_exactly: Callable[[Callable[[], RayStage]], None],
) -> None:
    assert_goes_on_exactly(stage)

    def without_hulls() -> RayStage:
        one = stage()
        one.scene_model = DNeRF(replace(TINY, hull=False, empty_from=0.0))
        return one

    assert_goes_on_exactly(without_hulls)


def test_a_batch_may_have_fewer_rays_where_no_mattes_tell_what_is_empty(
    trainer: Trainers, datamodule: SceneDataModule
) -> None:
    sizes = []
    for hull in (True, False):
        one = stage()
        one.schedule = replace(QUICK, rays_without_hull=7)
        one.scene_model = DNeRF(replace(TINY, hull=hull))
        fit(one, trainer, datamodule)
        sizes.append(len(one.draw(ParallelBatch(0, [])).image))
    assert sizes == [QUICK.rays, 7]


def test_an_unknown_term_and_an_unknown_part_are_named(
    trainer: Trainers, datamodule: SceneDataModule
) -> None:
    with pytest.raises(DevrfError, match=r"ray_stage.loss: unknown term 'elastic'"):
        stage(loss={"elastic": 1.0})
    with pytest.raises(DevrfError, match=r"dnerf has no part 'codes'"):
        fit(stage(ProtocolStage("joint", "both", frozen=("codes",))), trainer, datamodule)


@pytest.mark.parametrize("sampling", ["occupancy", "hierarchical"])
def test_a_scene_without_end_is_learned_and_comes_back(
    trainer: Trainers, tiny_room: Scene, tmp_path: Path, sampling: Any
) -> None:
    one = stage()
    one.scene_model = DNeRF(replace(TINY, sampling=sampling, coarse=8, fine=8))
    fitted = fit(one, trainer, RenderedDataModule(lambda: tiny_room, None))
    save_checkpoint(fitted, tmp_path / "room.ckpt")
    model = load_checkpoint(tmp_path / "room.ckpt").model
    assert model.space == tiny_room.space and model.box == tiny_room.bounds.box
    seen = Renderer(model).view(tiny_room.static.test.cameras, 0, 0.5, 1.0)
    # The last sample stands for all that is behind it: no background shows.
    torch.testing.assert_close(seen.opacity, torch.ones_like(seen.opacity))

"""How any method is learned from rays: which pixels are drawn, what is frozen, what resumes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.protocol import ProtocolStage
from devrf.errors import DevrfError
from devrf.methods.dnerf.model import DNeRF, DNeRFSettings
from devrf.methods.hypernerf.model import HyperNeRF, HyperNeRFSettings
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

SMALL = {"width": 8, "depth": 2, "bands": 2, "sampling": "occupancy", "steps": 16}
TINY = DNeRFSettings(**SMALL, occupancy_side=8, deformation_width=8, deformation_depth=2)
# All that a peer may keep beside its weights: windows, codes, occupancy that it learns.
WHOLE = HyperNeRFSettings(
    **SMALL, occupancy_side=8, separate_coarse=False, hull=False, empty_from=0.0, code=3,
    warp_width=8, warp_depth=2, slicing_width=8, slicing_depth=2,
)  # fmt: skip
Make = Callable[..., RayStage]
Fit = Callable[..., RayStage]


def test_a_killed_run_goes_on_to_the_same_weights(
    ray_stage: Make, stopped_and_resumed: Callable[..., Any]
) -> None:
    def stage() -> RayStage:
        return ray_stage(HyperNeRF(WHOLE), loss={"render": 1.0, "elastic": 0.01})

    _, _, resumed = stopped_and_resumed(stage, at=2)
    assert resumed.position.iteration == 4


def test_a_checkpoint_is_there_to_be_shown_and_a_later_stage_learns_it(
    ray_stage: Make, fit: Fit, stored: Callable[[RayStage], LoadedCheckpoint]
) -> None:
    rest = stored(fit(ray_stage(DNeRF(TINY), "canonical")))
    assert not rest.model.training
    assert ray_stage(DNeRF(TINY), "dynamic", earlier=rest).scene_model.training


def test_dynamic_never_reads_the_static_set(
    ray_stage: Make,
    fit: Fit,
    serve: Callable[[Scene], SceneDataModule],
    same_weights: Callable[[RayStage, RayStage], None],
    tiny_scene: Scene,
) -> None:
    """It learns the same, in the same box, where static images are black."""
    static, stages = tiny_scene.static, []
    black = replace(static.train, pixels=torch.zeros_like(static.train.pixels), depth=None)
    dark = replace(tiny_scene, static=replace(static, train=black))
    for scene in (tiny_scene, dark):
        torch.manual_seed(0)
        stages.append(fit(ray_stage(DNeRF(TINY), "dynamic"), data=serve(scene)))
    same_weights(*stages)
    assert stages[0].scene_model.box == stages[1].scene_model.box


@pytest.mark.parametrize(("share", "static"), [(0.5, 16), (0.25, 8)])
def test_a_fixed_share_of_a_joint_batch_is_static(
    share: float, static: int, ray_stage: Make, fit: Fit, tiny_scene: Scene
) -> None:
    stage = fit(ray_stage(DNeRF(TINY), static_share=share))
    image = stage.draw()[0]
    assert len(image) == 32 and int((image < len(tiny_scene.static.train)).sum()) == static


def test_the_curriculum_adds_frames(
    ray_stage: Make, fit: Fit, four_frames: SceneDataModule
) -> None:
    stage = fit(ray_stage(DNeRF(TINY), "dynamic", curriculum=0.99, rays=400), data=four_frames)
    views = stage.datamodule.training_views("dynamic", stage.device)
    assert views.frames is not None
    for iteration, frames in ((0, 3), (4, 4)):
        stage.position.iteration = iteration
        image = stage.draw()[0]
        assert len(views.frames[image].unique()) == frames


def test_the_first_batches_may_see_the_centre_half_alone(ray_stage: Make, fit: Fit) -> None:
    stage = fit(ray_stage(DNeRF(TINY), centre_crop=2, rays=2000))  # of 24×18 pixels
    for iteration, rows, columns in ((1, (4, 13), (6, 17)), (2, (0, 17), (0, 23))):
        stage.position.iteration = iteration
        flat = stage.draw()[1]
        assert (int(flat.min()) // 24, int(flat.max()) // 24) == rows
        assert (int((flat % 24).min()), int((flat % 24).max())) == columns


@pytest.mark.parametrize(("step", "times"), [("joint", 3), ("dynamic", 2)])
def test_a_batch_may_have_few_times(
    step: str, times: int, ray_stage: Make, fit: Fit, four_frames: SceneDataModule
) -> None:
    stage = fit(ray_stage(DNeRF(TINY), step, times_per_batch=times, rays=60), data=four_frames)
    image = stage.draw()[0]
    if step == "joint":
        static = len(stage.datamodule.training_views("static", stage.device))
        assert (image[:30] < static).all()
        image = image[30:] - static
    frames = stage.datamodule.training_views("dynamic", stage.device).frames[image]  # type: ignore[index]
    # Two times with as many rays each, one after the other.
    first, second = frames.chunk(2)
    assert len(first.unique()) == len(second.unique()) == 1 and first[0] != second[0]


def test_a_part_of_a_batch_has_fewer_times(
    ray_stage: Make, fit: Fit, four_frames: SceneDataModule
) -> None:
    stage = fit(ray_stage(DNeRF(TINY), "dynamic", times_per_batch=2, rays=64), data=four_frames)
    frames = stage.datamodule.training_views("dynamic", stage.device).frames
    assert frames is not None and stage.useful_share == 1 / 2
    for share, times in ((1.0, 2), (1 / 2, 1), (1 / 8, 1)):
        stage.batch_size.share = share
        image = stage.draw()[0]
        assert len(image) == 64 * share and len(frames[image].unique()) == times


def test_a_batch_may_have_fewer_rays_where_no_masks_tell_what_is_empty(
    ray_stage: Make, fit: Fit
) -> None:
    sizes = []
    for hull in (True, False):
        stage = fit(ray_stage(DNeRF(replace(TINY, hull=hull)), rays_without_hull=7))
        sizes.append(len(stage.draw()[0]))
    assert sizes == [32, 7]


def test_steps_may_be_smaller_where_no_masks_tell_what_is_empty(ray_stage: Make, fit: Fit) -> None:
    for hull, rate in ((True, 2e-3), (False, 5e-4)):
        rates = {"learning_rate": 2e-3, "learning_rate_without_hull": 5e-4}
        stage = fit(ray_stage(DNeRF(replace(TINY, hull=hull)), **rates))
        assert {group["base_lr"] for group in stage.optimizer.param_groups} == {rate}
        assert stage.schedule.learning_rate_factor(0) == 1


def test_a_method_may_learn_before_random_colours_where_all_images_have_masks(
    ray_stage: Make, fit: Fit, tiny_scene: Scene, serve: Callable[[Scene], SceneDataModule]
) -> None:
    class Varied(DNeRF):
        random_background = True

    bare = replace(tiny_scene.static.train, pixels=tiny_scene.static.train.pixels[..., :3])
    half = replace(tiny_scene, static=replace(tiny_scene.static, train=bare))
    shapes = []
    for model, scene in ((DNeRF, tiny_scene), (Varied, tiny_scene), (Varied, half)):
        stage = fit(ray_stage(model(TINY)), data=serve(scene))
        shapes.append(tuple(stage.background(stage.draw()[0], stage.generator).shape))
    assert shapes == [(3,), (32, 3), (3,)]


def test_rates_decay_exponentially_or_as_half_a_cosine_after_a_warm_up(ray_stage: Make) -> None:
    rates = {"iterations": 101, "learning_rate": 1e-2, "final_learning_rate": 1e-4}
    plain = ray_stage(DNeRF(TINY), **rates)
    factors = [plain.schedule.learning_rate_factor(n) for n in (0, 50, 100)]
    assert factors == pytest.approx([1, 0.1, 0.01])
    rates |= {"final_learning_rate": 0.0, "decay": "cosine"}
    cosine = ray_stage(DNeRF(TINY), **rates)
    factors = [cosine.schedule.learning_rate_factor(n) for n in (0, 50, 100)]
    assert factors == pytest.approx([1, 0.5, 0])
    warm = ray_stage(DNeRF(TINY), warmup=9 / 101, **rates)  # nine iterations below the decay's rate
    for n in (0, 4, 9, 50):
        expected = cosine.schedule.learning_rate_factor(n) * min(1, (n + 1) / 10)
        assert warm.schedule.learning_rate_factor(n) == pytest.approx(expected)
    with pytest.raises(DevrfError, match="final_learning_rate: expected more than 0, or decay"):
        ray_stage(DNeRF(TINY), final_learning_rate=0.0)


def test_a_checkpoint_shows_what_was_learned(
    ray_stage: Make, fit: Fit, stored: Callable[[RayStage], LoadedCheckpoint], tiny_scene: Scene
) -> None:
    stage = fit(ray_stage(DNeRF(TINY)))
    loaded = stored(stage)
    assert isinstance(loaded.model, DNeRF) and loaded.metadata.complete
    cameras = tiny_scene.dynamic.test.cameras
    now, then = (Renderer(m).view(cameras, 1, 0.7, 1.0) for m in (stage.scene_model, loaded.model))
    assert torch.equal(now.color, then.color)


def test_an_unknown_term_and_an_unknown_part_are_named(ray_stage: Make, fit: Fit) -> None:
    with pytest.raises(DevrfError, match=r"ray_stage.loss: unknown term 'elastic'"):
        ray_stage(DNeRF(TINY), loss={"elastic": 1.0})
    with pytest.raises(DevrfError, match=r"dnerf has no part 'codes'"):
        fit(ray_stage(DNeRF(TINY), ProtocolStage("joint", "both", frozen=("codes",))))


def test_a_batch_has_a_time_at_least(ray_stage: Make) -> None:
    with pytest.raises(DevrfError, match=r"ray_stage\.schedule\.times_per_batch"):
        ray_stage(DNeRF(TINY), times_per_batch=0)

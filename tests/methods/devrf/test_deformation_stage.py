"""The deformation stage, trained for moments from plain Lightning code, without Hydra."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import LambdaCallback

from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.geometry.box import Box
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.priors import Elastic
from devrf.methods.devrf.extensions.tracks import StartAlongFlow
from devrf.methods.devrf.settings import VisitSettings
from devrf.ops.adam import add_total_variation_gradient
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, Views, both_mapped
from recorder import Entry, by_samples, recording

SHORT = DeformationSchedule(levels=(Level(4, 20), Level(8, 10)), rays=256)
TINY = DeformationSchedule(levels=(Level(4, 4), Level(6, 2)), rays=64)
FAST = VisitSettings(learning_rate=5e-3, views="all", pixels="occupied")


def test_two_steps_move_the_first_frame_only(rest, datamodule, trainer):
    before = {k: v.clone() for k, v in rest.model.canonical.named_parameters()}
    stage, fit = DeformationStage(rest, SHORT), trainer(max_steps=2)
    fit.fit(stage, datamodule=datamodule)
    assert stage.position.iteration == fit.global_step == 2
    assert stage.field.backward_slices[1].abs().max() > 0
    # Two steps of Adam move no voxel further than twice the rate, or little more.
    assert stage.field.backward_slices[1].abs().max() < 2.5e-3
    for frames in (stage.field.backward_slices, stage.field.forward_slices):
        assert not frames[0].any() and not frames[2].any()
    for name, value in stage.scene_model.canonical.named_parameters():
        assert torch.equal(value, before[name])


def test_an_iteration_asks_little_of_the_device(rest, fit):
    iterations: list[list[Entry]] = []
    schedule = DeformationSchedule(levels=(Level(4, 4),), rays=64)
    fit(recording(DeformationStage, iterations)(rest, schedule))
    entries = iterations[-1]
    assert len(entries) <= 59
    assert sum(entry.waits for entry in entries) == 1  # for the number of samples
    # Nothing but the number of samples and the numbers of the step differs from the one before.
    assert by_samples(iterations[-2]) == by_samples(entries)
    assert any("K" in entry for entry in by_samples(entries))


def test_a_scene_at_rest_has_no_motion_to_learn(rest, tiny_scene, serve, trainer):
    module = serve(replace(tiny_scene, dynamic=tiny_scene.static))
    with pytest.raises(DevrfError, match="is at rest"):
        trainer(max_steps=1).fit(DeformationStage(rest, SHORT), datamodule=module)


def test_a_misspelt_mean_is_refused(rest):
    with pytest.raises(DevrfError, match="loss.flow_mean: expected rays or samples, not ray"):
        DeformationStage(rest, flow_mean="ray")


@pytest.mark.parametrize("views", ["one", "all"])
def test_a_visit_shows_its_pixels_as_often_as_said(rest, fit, views: Any):
    drawn = []

    class Watched(DeformationStage):
        def draw(self) -> Any:
            pixels = super().draw()
            assert self.phase is not None
            drawn.append((self.phase.stop - self.phase.start, len(pixels[0])))
            return pixels

    schedule = DeformationSchedule(levels=(Level(4, 6),), rays=1500)
    stage = fit(Watched(rest, schedule, VisitSettings(views=views, epochs=5.0)))
    pixels = (
        2 * stage.context.views.height * stage.context.views.width
    )  # of two views; the first visit has 12
    assert set(drawn) == {(12, round(5 * pixels / 12)), (6, min(1500, round(5 * pixels / 6)))}


def test_a_whole_schedule_sees_the_motion_better_than_the_rest_pose(
    rest, datamodule, tiny_scene, trainer
):
    schedule = DeformationSchedule(levels=(Level(4, 30), Level(8, 15)), rays=128)
    stage = DeformationStage(rest, schedule, FAST)
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    assert stage.position.iteration == stage.schedule.total == 135
    assert stage.scene_model.resolution == stage.scene_model.canonical.box.grid_shape(8**3)
    for frames in (stage.field.backward_slices, stage.field.forward_slices):
        assert not frames[0].any()
        assert (frames[1:].abs().amax(dim=(1, 2, 3, 4)) > 1e-3).all()
    # Two views of three frames: at rest there is nothing to win.
    renderer, train = Renderer(stage.scene_model), tiny_scene.dynamic.train
    views = [score(renderer, train, k, "white") for k in range(6)]
    gains = [view.psnr - view.rest_pose_psnr for view in views]
    assert gains[:2] == [0.0, 0.0]
    assert min(gains[2:]) > 0.5 and sum(gains[2:]) / 4 > 1


def enlarged(scene: Scene, factor: float) -> Scene:
    """The same images of a scene in another unit."""

    def seen(views: Views) -> Views:
        poses = views.cameras.camera_to_world.clone()
        poses[:, :, 3] *= factor
        return replace(views, cameras=replace(views.cameras, camera_to_world=poses))

    def large(box: Box) -> Box:
        return Box(tuple(factor * x for x in box.low), tuple(factor * x for x in box.high))

    bounds = scene.bounds
    assert bounds.motion is not None
    bounds = replace(
        bounds,
        box=large(bounds.box),
        motion=large(bounds.motion),
        near=factor * bounds.near,
        far=factor * bounds.far,
    )
    static, dynamic = both_mapped(scene.static, scene.dynamic, seen)
    return replace(scene, static=static, dynamic=dynamic, bounds=bounds)


def test_motion_in_edges_of_the_box_is_the_same_in_any_unit(
    canonical, fit, serve, tiny_scene, caplog
):
    box = VisitSettings(learning_rate=5e-3, unit="box", views="all")
    schedule = DeformationSchedule(levels=(Level(4, 20), Level(6, 10)), rays=128)
    loss = {"render": 1.0, "cycle": 100.0, "tv": 1.0}
    moved = {}
    for factor in (1.0, 1024.0, 1 / 1024):  # of which numbers are rounded alike
        data = serve(enlarged(tiny_scene, factor))
        torch.manual_seed(0)
        rest = fit(canonical(iterations=30), data=data).result()
        stage = fit(DeformationStage(rest, schedule, box, loss), data=data)
        moved[factor] = stage.field.backward_slices[1:] / factor
    length = tiny_scene.bounds.whole.longest
    assert moved[1.0].abs().max() > 0.01 * length
    for factor in (1024.0, 1 / 1024):
        assert (moved[factor] - moved[1.0]).abs().mean() < 0.1 * moved[1.0].abs().mean()
    assert "world units" not in caplog.text
    fit(DeformationStage(rest, TINY), data=data)
    assert "give schedule.visit.unit=box, or scale the cameras" in caplog.text


def test_total_variation_alone_smooths_both_directions(rest, datamodule, trainer):
    # With "render" at a vanishing weight only the closed-form gradient moves Δ_f.
    stage = DeformationStage(rest, SHORT, loss={"render": 1e-20, "tv": 1.0})
    before, mean = [], []

    def peak(*_: Any) -> None:
        stage.active.forward.data[1, 1, 1] = 0.5
        before.append(stage.active.forward.detach().clone())

    def look(*_: Any) -> None:
        mean.append(stage.optimizer.state[stage.active.forward]["mean"].clone())

    watch = LambdaCallback(on_train_batch_start=peak, on_train_batch_end=look)
    trainer(watch, max_steps=1).fit(stage, datamodule=datamodule)
    forward, slope = stage.field.forward_slices[1], torch.zeros_like(before[0])
    assert forward[1, 1, 1, 0] < 0.5 and forward[0, 1, 1, 0] > 0
    add_total_variation_gradient(before[0], slope, 1.0)
    # The first step's mean is a tenth of the gradient.
    expected = 0.1 * slope * (max(stage.field.shape) / 128 / 256 / 6)
    torch.testing.assert_close(mean[0], expected)


def test_each_level_has_its_rates_and_its_factor_of_all_terms_but_render(rest, datamodule, trainer):
    second = Level(6, 2, lr_factor=0.5, lr_final_factor=0.01, other_terms=0.25)
    schedule = DeformationSchedule((Level(4, 2, other_terms=0), second), rays=16)
    loss = {"render": 1, "elastic": 0.2, "tv": 128 * 16}
    visit = VisitSettings(learning_rate=0.01)
    stage = DeformationStage(
        rest, schedule, visit, loss, extensions={"e": Elastic()}, iterations_per_step=1
    )
    weights, smoothing, rates = {}, {}, {0: [], 1: []}

    def note(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        level, group = stage.phase.level, stage.optimizer.param_groups[0]
        weights[level], smoothing[level] = stage.context.weights, group["smoothing"]
        rates[level].append(group["lr"])

    watch = LambdaCallback(on_train_batch_end=note)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert weights == {0: {"render": 1}, 1: {"render": 1, "elastic": pytest.approx(0.05)}}
    assert smoothing == {0: 0, 1: pytest.approx(max(stage.field.shape) / 6 / 4)}
    assert set(rates[0]) == {0.01}
    # Frame 1 has four iterations, frame 2 two; within each the rate falls towards a hundredth.
    falls = [0.005 * 0.01**share for share in (0, 1 / 4, 1 / 2, 3 / 4, 0, 1 / 2)]
    assert rates[1] == pytest.approx(falls)


def test_the_elastic_term_counts_more_while_a_visit_at_the_coarsest_level_begins(
    rest, datamodule, trainer
):
    schedule = DeformationSchedule((Level(4, 2), Level(6, 1)), rays=16)
    loss = {"render": 1.0, "elastic": 0.5}
    elastic = {"elastic": Elastic(initial_factor=16.0)}
    stage = DeformationStage(rest, schedule, loss=loss, extensions=elastic, iterations_per_step=1)
    weights = {0: [], 1: []}

    def note(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        weights[stage.phase.level].append(stage.context.weights["elastic"])

    watch = LambdaCallback(on_train_batch_end=note)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    # Frame 1 has four iterations, frame 2 two; within each 16 falls towards 1.
    assert weights[0] == pytest.approx([8.0, 4.0, 2.0, 1.0, 8.0, 2.0])
    assert set(weights[1]) == {0.5}


def test_the_flow_of_a_moving_camera_neither_starts_nor_teaches_a_frame(
    rest, tiny_scene, serve, trainer
):
    train = tiny_scene.dynamic.train
    train = train[(train.view == 0).nonzero()[:, 0]]
    visit, tracks = VisitSettings(learning_rate=1e-9), {"tracks": StartAlongFlow("flow")}
    for moving in (False, True):
        if moving:
            train = replace(train, view=torch.arange(len(train)))
        module = serve(replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=train)))
        stage = DeformationStage(rest, SHORT, visit, iterations_per_step=1, extensions=tracks)
        trainer(max_steps=1).fit(stage, datamodule=module)
        assert (stage.field.forward_slices[1].abs().amax() > 1e-3) is not moving
        assert ("flow" in stage.context.weights) is not moving


def test_state_and_model_hold_what_an_active_frame_has_learned(rest, datamodule, trainer):
    stage, last = DeformationStage(rest, TINY, FAST, iterations_per_step=3), []

    def look(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        frame, learned = stage.active.number, stage.active.forward.detach().clone()
        stored = stage.state_dict()["scene_model.deformation.frames.forward_slices"][frame]
        assert learned.any() and torch.equal(stored, learned)
        assert torch.equal(stage.current_model().deformation.forward_slices[frame], learned)
        last[:] = [learned]

    watch = LambdaCallback(on_train_batch_end=look)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    # The last frame was written back.
    assert torch.equal(stage.field.forward_slices[2], last[0])


def test_where_the_field_is_kept_changes_what_is_learned_by_its_rounding_alone(
    rest, datamodule, trainer
):
    fields = []
    for store, rounded in (("device", False), ("host", False), ("host", True)):
        torch.manual_seed(0)
        visit = replace(FAST, store=store, store_half=rounded)
        stage = DeformationStage(rest, TINY, visit)
        trainer(max_epochs=1).fit(stage, datamodule=datamodule)
        assert stage.field.forward_slices.dtype == (torch.float16 if rounded else torch.float32)
        fields.append(stage.field.backward_slices.float())
    exact, on_host, in_half = fields
    assert torch.equal(exact, on_host) and not torch.equal(exact, in_half)
    torch.testing.assert_close(exact, in_half, atol=0.05, rtol=0)


@pytest.mark.parametrize(
    ("moments", "fine"), [("fresh", [1, 2, 3, 4, 1, 2]), ("carried", [1, 2, 3, 4, 5, 6])]
)
def test_adam_begins_anew_at_each_visit_or_goes_on_above_the_coarsest_level(
    rest, datamodule, trainer, moments, fine
):
    # Three frames; frame 1 gets the share of frame 0 as well.
    schedule = DeformationSchedule(levels=(Level(4, 2), Level(6, 2)), rays=16)
    visit = replace(FAST, adam_state=moments)
    stage = DeformationStage(rest, schedule, visit, iterations_per_step=1)
    steps: dict[int, list[int]] = {0: [], 1: []}

    def count(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        state = stage.optimizer.state[stage.optimizer.param_groups[0]["params"][0]]
        steps[stage.phase.level].append(int(state["steps"]))

    watch = LambdaCallback(on_train_batch_end=count)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert steps == {0: [1, 2, 3, 4, 1, 2], 1: fine}


def test_a_frame_has_a_copy_of_the_frame_before_it(rest, four_frames, trainer):
    schedule = DeformationSchedule(levels=(Level(4, 2), Level(5, 1)), rays=64)
    stage, visited = DeformationStage(rest, schedule), []

    def look(trainer: Trainer, stage: DeformationStage, *_: Any) -> None:
        frame = stage.active
        visit = (stage.phase.level, frame.number)
        if visited[-1:] != [visit]:
            visited.append(visit)
        neighbour = stage.field.forward_slices[frame.number - 1]
        assert torch.equal(frame.previous_forward, neighbour)
        assert bool(neighbour.any()) == (frame.number > 1)

    watch = LambdaCallback(on_train_batch_start=look)
    trainer(watch, max_epochs=1).fit(stage, datamodule=four_frames)
    assert visited == [(0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3)]
    assert stage.position.iteration == stage.schedule.total == 8 + 4

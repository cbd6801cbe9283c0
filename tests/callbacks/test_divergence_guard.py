"""Divergence is rolled back once, then ends the stage; a sound stage is not touched."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from torch import Tensor

from devrf.callbacks import DivergenceGuard, PeriodicCheckpoint, TrainingRecord
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import CanonicalRates
from devrf.scenes.scene import Scene

# Three frames. Level 0: frame 1 in 0–11, frame 2 in 12–17; level 1: 18–25 and 26–29.
MOVING = DeformationSchedule(levels=(Level(4, 6), Level(6, 4)), rays=64)
# A phase of the canonical stage from 0 to 9, one from 10 to 23; and longer ones.
SHORT: dict[str, Any] = {"iterations": 24, "doublings": (10,), "decay_iterations": 100}
LONG: dict[str, Any] = {**SHORT, "iterations": 60, "doublings": (20,), "rays": 128}


@pytest.fixture(autouse=True)
def warnings_of_devrf(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger="devrf")


@pytest.fixture
def moving(rest: LoadedCheckpoint) -> Callable[..., DeformationStage]:
    """``moving(**schedule)``: a deformation stage of the tiny scene, by default ``MOVING``."""

    def build(**schedule: Any) -> DeformationStage:
        made = DeformationSchedule(**schedule, rays=64) if schedule else MOVING
        return DeformationStage(copy.deepcopy(rest), made, iterations_per_step=1)

    return build


@pytest.fixture
def without_masks(tiny_scene: Scene, serve: Callable[[Scene], SceneDataModule]) -> SceneDataModule:
    """Serves the tiny scene without alpha masks."""

    def bare(capture: Any) -> Any:
        pixels = capture.train.pixels[..., :3].contiguous()
        return replace(capture, train=replace(capture.train, pixels=pixels))

    scene = replace(tiny_scene, static=bare(tiny_scene.static), dynamic=bare(tiny_scene.dynamic))
    return serve(scene)


class Spoil(Callback):
    """Spoils a parameter or gradient once at each of some iterations."""

    def __init__(self, what: str, *iterations: int, group: int = 0) -> None:
        self.what = what
        self.group = group
        self.iterations = list(iterations)
        self.rates: list[tuple[int, float]] = []
        self.drawn: list[tuple[int, Tensor]] = []

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: Any, optimizer: Any) -> None:
        self.rates.append((pl_module.iteration, optimizer.param_groups[0]["lr"]))
        if pl_module.iteration in self.iterations:
            self.iterations.remove(pl_module.iteration)
            value = optimizer.param_groups[self.group]["params"][0]
            with torch.no_grad():
                if self.what == "gradient":
                    value.grad.view(-1)[5] = math.nan
                else:
                    value.fill_(float(self.what))

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        self.drawn.append((pl_module.iteration, pl_module.generator.get_state()))


def finite(state: dict[str, Any]) -> bool:
    values = [v for v in state.values() if isinstance(v, Tensor) and v.is_floating_point()]
    return all(bool(torch.isfinite(v).all()) for v in values)


def finite_file(path: Path) -> bool:
    return finite(read_checkpoint_file(path)["state_dict"])


@pytest.mark.parametrize("what", ["gradient", "nan", "inf"])
def test_the_first_time_is_rolled_back(fit, canonical, caplog, what: str) -> None:
    spoil, guard = Spoil(what, 14), DivergenceGuard(every_iterations=4)
    stage = fit(canonical(**SHORT), TrainingRecord(), spoil, guard)
    assert finite(stage.state_dict())
    assert (stage.iteration, stage.num_rollbacks, stage.lr_scale) == (24, 1, 0.5)
    assert stage.record["num_rollbacks"] == 1
    (said,) = caplog.messages
    # Checked after 18 iterations, or where the phase ended: the phase is learned again.
    assert said.startswith("canonical: ")
    assert " of 24 (13x8x13): back to iteration 10, learning rates at 0.5" in said
    rates = [rate for iteration, rate in spoil.rates if iteration == 10]
    assert rates[1] == pytest.approx(rates[0] / 2)
    first, again = (state for iteration, state in spoil.drawn if iteration == 10)
    assert not torch.equal(first, again)


def test_the_iteration_that_went_wrong_is_named(fit, canonical, caplog) -> None:
    fit(canonical(**SHORT), Spoil("nan", 12, group=1), DivergenceGuard())
    # The colours, spoilt in iteration 12: in the loss of the next, the fourteenth.
    assert "the loss is nan by iteration 14 of 24 (13x8x13): back to iteration 10" in caplog.text


def test_the_second_time_ends_the_stage_in_its_last_good_state(
    fit, canonical, tmp_path: Path
) -> None:
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    spoil, guard = Spoil("nan", 3, 14, group=1), DivergenceGuard(every_iterations=4)
    with pytest.raises(DevrfError) as caught:
        fit(canonical(**SHORT), spoil, guard, saving)
    said = str(caught.value)
    # Checked before a file is written, after every iteration.
    assert said.startswith("canonical stage: values of color are not finite by iteration 15 of 24")
    for part in (
        "again after learning rates were cut to 0.5",
        "what it was at iteration 10 is kept",
        "lower schedule.rates or the weights of loss.fine",
    ):
        assert part in said
    newest = tmp_path / "canonical-progress-10.ckpt"
    assert newest in set(tmp_path.iterdir())
    assert all(finite_file(path) for path in tmp_path.iterdir())
    # A stage that goes on from there remembers.
    again = fit(canonical(**SHORT), DivergenceGuard(), ckpt_path=newest)
    assert (again.iteration, again.num_rollbacks, again.lr_scale) == (24, 2, 0.25)


def test_what_went_wrong_is_never_saved(fit, canonical, tmp_path: Path) -> None:
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    guard = DivergenceGuard(every_iterations=1000)
    stage = fit(canonical(**SHORT), Spoil("nan", 17), guard, saving)
    # Noticed before the file of iteration 18, not at the end of the phase.
    assert stage.num_rollbacks == 1 and finite(stage.state_dict())
    assert all(finite_file(path) for path in tmp_path.iterdir())


def test_the_last_iteration_is_looked_at(fit, canonical) -> None:
    stage = fit(canonical(**SHORT), Spoil("gradient", 23), DivergenceGuard())
    assert stage.num_rollbacks == 1 and stage.iteration == 24 and finite(stage.state_dict())


@pytest.mark.parametrize("iteration", [0, 13, 21, 29])
def test_a_frame_is_visited_again(fit, moving, caplog, iteration: int) -> None:
    stage = fit(moving(), Spoil("nan", iteration), DivergenceGuard())
    phase = MOVING.phase(iteration, 3)
    assert f"(frame {phase.frames[0]}, " in caplog.text
    assert f"back to iteration {phase.start}," in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (30, 1) and finite(stage.state_dict())


def test_parallel_frames_are_visited_again_together(
    fit, moving, caplog, four_frames: SceneDataModule
) -> None:
    stage = moving(levels=(Level(4, 2), Level(6, 5, parallel_frames=2)))
    fit(stage, Spoil("nan", 15), DivergenceGuard(), data=four_frames)
    assert "of 18 (frames 1, 3, " in caplog.text and "back to iteration 13," in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (18, 1) and finite(stage.state_dict())


def test_a_deformation_that_goes_wrong_twice_ends(fit, moving) -> None:
    stage = moving()
    with pytest.raises(DevrfError, match="deformation stage: .*frame 2.*motion.learning_rate"):
        fit(stage, Spoil("nan", 3, 15), DivergenceGuard())
    assert stage.iteration == 12 and finite(stage.state_dict())


@pytest.mark.parametrize(
    ("density", "words", "carve"), [("-100", "empty", True), ("100", "opaque", False)]
)
def test_a_field_that_empties_or_fills_is_rolled_back(
    fit, canonical, caplog, density: str, words: str, carve: bool
) -> None:
    guard = DivergenceGuard(every_iterations=20)
    stage = fit(canonical(**LONG, carve=carve), Spoil(density, 40), guard)
    assert f"everything has become {words} by iteration" in caplog.text
    assert "data.background" in caplog.text and "data.box" in caplog.text
    assert stage.num_rollbacks == 1 and stage.iteration == 60


@pytest.mark.parametrize("masks", [True, False])
def test_a_field_that_keeps_emptying_ends_the_stage(
    fit, canonical, datamodule: SceneDataModule, without_masks: SceneDataModule, masks: bool
) -> None:
    stage = canonical(**{**LONG, "doublings": ()}, alpha_init=0.1)
    spoil, guard = Spoil("-100", 20, 40), DivergenceGuard(every_iterations=20)
    with pytest.raises(DevrfError) as caught:
        fit(stage, spoil, guard, data=datamodule if masks else without_masks)
    said = str(caught.value)
    assert said.startswith("canonical stage: everything has become empty by iteration ")
    assert "data.background" in said and "begin afresh with resume=false" in said
    assert finite(stage.state_dict()) and stage.iteration == 0


def test_a_stage_that_never_saw_anything_warns(fit, canonical, caplog) -> None:
    clear = {"alpha_init": 1e-7, "rates": CanonicalRates(density=1e-9)}
    guard = DivergenceGuard(every_iterations=20)
    stage = fit(canonical(**{**SHORT, "doublings": ()}, **clear), guard)
    assert "canonical: nothing is to be seen at the end (is data.background" in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (24, 0)
    # With a second phase there is nothing to draw pixels from.
    with pytest.raises(DevrfError, match="empty by iteration 10: check data.background"):
        fit(canonical(**SHORT, **clear), guard)


def test_motion_that_leaves_the_image_without_masks_only_warns(
    fit, moving, without_masks: SceneDataModule, caplog
) -> None:
    stage = moving(levels=(Level(4, 40),))
    fit(stage, Spoil("100", 45), DivergenceGuard(every_iterations=20), data=without_masks)
    assert caplog.text.count("everything has become empty by") == 1
    assert stage.num_rollbacks == 0


def test_a_frame_whose_loss_stands_out_is_named(
    fit, moving, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    usual = DeformationStage.loss

    def dear(stage: DeformationStage, *others: Any) -> Any:
        total, terms = usual(stage, *others)
        factor = 50.0 if stage.iteration >= 50 else 1.0
        return total * factor, {**terms, "render": terms["render"] * factor}

    monkeypatch.setattr(DeformationStage, "loss", dear)
    guard = DivergenceGuard()
    seen = {"kind": "level 1", "visited": [0.01, 0.011, 0.012, 0.01]}
    guard.load_state_dict({**guard.state_dict(), **seen})
    monkeypatch.setattr(guard, "_reset", lambda: None)
    fit(moving(levels=(Level(4, 20),)), guard)
    assert "times that of the frames before" in caplog.text and "(frame 2, " in caplog.text


def test_a_sound_stage_is_not_touched(fit, canonical, moving, caplog) -> None:
    def learned(*callbacks: Callback) -> list[dict[str, Any]]:
        stages = [canonical(**SHORT), moving()]
        torch.manual_seed(4)
        return [fit(stage, *callbacks).state_dict() for stage in stages]

    watched, alone = learned(DivergenceGuard(every_iterations=3)), learned()
    assert caplog.messages == []
    for one, other in zip(watched, alone, strict=True):
        for name, value in one.items():
            if isinstance(value, Tensor):
                assert torch.equal(value, other[name]), name


def test_checks_cost_next_to_nothing(fit, canonical, monkeypatch: pytest.MonkeyPatch) -> None:
    spent = [0.0]
    for name in ("on_train_batch_start", "on_train_batch_end"):
        usual = getattr(DivergenceGuard, name)

        def timed(*arguments: Any, usual: Any = usual) -> None:
            began = time.process_time()
            usual(*arguments)
            spent[0] += time.process_time() - began

        monkeypatch.setattr(DivergenceGuard, name, timed)
    stage = canonical(**{**SHORT, "iterations": 120, "side": 24, "rays": 512})
    began = time.process_time()
    fit(stage, DivergenceGuard())
    assert spent[0] < 0.02 * (time.process_time() - began)


@pytest.mark.parametrize(("every", "factor"), [(0, 0.5), (10, 0.0), (10, 1.5)])
def test_senseless_settings_are_refused(every: int, factor: float) -> None:
    with pytest.raises(DevrfError, match="callbacks.health: expected"):
        DivergenceGuard(every, factor)

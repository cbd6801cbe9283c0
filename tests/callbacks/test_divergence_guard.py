"""Learning that goes wrong is taken back once, then ended; learning that goes well is let alone."""

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
from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO, LoadedCheckpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import CanonicalRates
from devrf.scenes.scene import Scene

SMALL = Architecture(channels=4, width=8, frequencies=1)
SCHEDULE = CanonicalSchedule(
    search_iterations=0,
    search_side=12,
    carve=True,
    iterations=24,
    side=12,
    doublings=(10,),
    decay_iterations=100,
    rays=64,
)
# Three frames. Level 0: frame 1 in 0–11, frame 2 in 12–17; level 1: 18–25 and 26–29.
MOVING = DeformationSchedule(sides=(4, 6), iterations_per_frame=(6, 4), rays=64)


class Spoil(Callback):
    """Spoils something once at each of some iterations, as if the arithmetic had gone wrong."""

    def __init__(self, what: str, *iterations: int, group: int = 0) -> None:
        self.what = what
        self.group = group
        self.iterations = list(iterations)
        self.rates: list[tuple[int, float]] = []
        self.drawn: list[tuple[int, Tensor]] = []

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: Any, optimizer: Any) -> None:
        group = optimizer.param_groups[0]
        self.rates.append((pl_module.iteration, group["lr"]))
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


@pytest.fixture
def fit(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> Callable[..., ScheduledStage]:
    def learn(stage: ScheduledStage, *callbacks: Callback, **how: Any) -> ScheduledStage:
        made = trainer(*callbacks, max_epochs=1, log_every_n_steps=1000)
        made.strategy.checkpoint_io = ChecksummedCheckpointIO()
        made.fit(stage, datamodule=how.pop("data", datamodule), **how)
        return stage

    return learn


def canonical(**changes: Any) -> CanonicalStage:
    return CanonicalStage(SCHEDULE, SMALL, iterations_per_step=1, **changes)


def finite(state: dict[str, Any]) -> bool:
    values = [v for v in state.values() if isinstance(v, Tensor) and v.is_floating_point()]
    return all(bool(torch.isfinite(v).all()) for v in values)


@pytest.mark.parametrize("what", ["gradient", "nan", "inf"])
def test_once_is_taken_back(fit, caplog: pytest.LogCaptureFixture, what: str) -> None:
    spoil = Spoil(what, 14)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        stage = fit(canonical(), TrainingRecord(), spoil, DivergenceGuard(every_iterations=4))
    assert finite(stage.state_dict())
    assert (stage.iteration, stage.num_rollbacks, stage.lr_scale) == (24, 1, 0.5)
    assert stage.record["num_rollbacks"] == 1
    (said,) = caplog.messages
    # Looked at after 18 iterations, or where the phase ended: the phase of iteration 10 is
    # learned again.
    assert said.startswith("canonical: ")
    assert " of 24 (13x8x13): back to iteration 10, learning rates at 0.5" in said
    rates = [rate for iteration, rate in spoil.rates if iteration == 10]
    assert rates[1] == pytest.approx(rates[0] / 2)
    first, again = (state for iteration, state in spoil.drawn if iteration == 10)
    assert not torch.equal(first, again)


def test_the_iteration_that_went_wrong_is_told(fit, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(canonical(), Spoil("nan", 12, group=1), DivergenceGuard(every_iterations=100))
    # The colours, spoilt in iteration 12: in the loss of the next, the fourteenth.
    assert "the loss is nan by iteration 14 of 24 (13x8x13): back to iteration 10" in caplog.text


def test_twice_ends_the_stage_as_it_last_was_well(fit, tmp_path: Path) -> None:
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    stage = canonical()
    with pytest.raises(DevrfError) as caught:
        fit(stage, Spoil("nan", 3, 14, group=1), DivergenceGuard(every_iterations=4), saving)
    said = str(caught.value)
    # Looked at before a file is written, after every iteration.
    assert said.startswith("canonical stage: values of color are not finite by iteration 15 of 24")
    assert "again after learning rates were cut to 0.5" in said
    assert "what it was at iteration 10 is kept" in said
    assert "lower schedule.rates or the weights of loss.fine" in said and "\n" not in said
    # The newest file is what was well; nothing is half-written.
    newest = tmp_path / "canonical-progress-10.ckpt"
    assert newest in set(tmp_path.iterdir())
    assert all(finite(read_checkpoint_file(path)["state_dict"]) for path in tmp_path.iterdir())
    # It can be gone on from, and remembers.
    again = canonical()
    fit(again, DivergenceGuard(), ckpt_path=str(newest))
    assert (again.iteration, again.num_rollbacks, again.lr_scale) == (24, 2, 0.25)


def test_what_went_wrong_is_never_saved(fit, tmp_path: Path) -> None:
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    stage = fit(canonical(), Spoil("nan", 17), DivergenceGuard(every_iterations=1000), saving)
    # Noticed before the file of iteration 18, not at the end of the phase.
    assert stage.num_rollbacks == 1 and finite(stage.state_dict())
    assert all(finite(read_checkpoint_file(path)["state_dict"]) for path in tmp_path.iterdir())


def test_the_last_iteration_is_looked_at(fit) -> None:
    stage = fit(canonical(), Spoil("gradient", 23), DivergenceGuard())
    assert stage.num_rollbacks == 1 and stage.iteration == 24 and finite(stage.state_dict())


@pytest.mark.parametrize("iteration", [0, 7, 13, 18, 21, 29])
def test_a_frame_is_visited_again(
    fit, rest: LoadedCheckpoint, caplog: pytest.LogCaptureFixture, iteration: int
) -> None:
    stage = DeformationStage(copy.deepcopy(rest), MOVING, iterations_per_step=1)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, Spoil("nan", iteration), DivergenceGuard())
    entered, frame = next((p.start, p.frames[0]) for p in [MOVING.phase(iteration, 3)])
    assert f"(frame {frame}, " in caplog.text and f"back to iteration {entered}," in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (30, 1) and finite(stage.state_dict())


def test_frames_that_are_visited_together_are_visited_again_together(
    fit, rest: LoadedCheckpoint, caplog: pytest.LogCaptureFixture, four_frames: SceneDataModule
) -> None:
    schedule = DeformationSchedule(
        sides=(4, 6), iterations_per_frame=(2, 5), rays=64, parallel_frames=(1, 2)
    )
    stage = DeformationStage(copy.deepcopy(rest), schedule, iterations_per_step=1)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, Spoil("nan", 15), DivergenceGuard(), data=four_frames)
    assert "of 18 (frames 1, 3, " in caplog.text and "back to iteration 13," in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (18, 1) and finite(stage.state_dict())


def test_a_deformation_that_goes_wrong_twice_ends(fit, rest: LoadedCheckpoint) -> None:
    stage = DeformationStage(copy.deepcopy(rest), MOVING, iterations_per_step=1)
    with pytest.raises(DevrfError, match="deformation stage: .*frame 2.*motion.learning_rate"):
        fit(stage, Spoil("nan", 3, 15), DivergenceGuard())
    assert stage.iteration == 12 and finite(stage.state_dict())


def test_a_field_that_empties_is_taken_back(fit, caplog: pytest.LogCaptureFixture) -> None:
    longer = replace(SCHEDULE, iterations=60, doublings=(20,), rays=128)
    stage = CanonicalStage(longer, SMALL, iterations_per_step=1)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, Spoil("-100", 40), DivergenceGuard(every_iterations=20))
    assert "everything has become empty by iteration" in caplog.text
    assert "data.background" in caplog.text and "data.box" in caplog.text
    assert stage.num_rollbacks == 1 and stage.iteration == 60


def test_a_field_that_fills_is_taken_back(fit, caplog: pytest.LogCaptureFixture) -> None:
    longer = replace(SCHEDULE, iterations=60, doublings=(20,), rays=128, carve=False)
    stage = CanonicalStage(longer, SMALL, iterations_per_step=1)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, Spoil("100", 40), DivergenceGuard(every_iterations=20))
    assert "everything has become opaque by iteration" in caplog.text
    assert stage.num_rollbacks == 1


@pytest.mark.parametrize("mattes", [True, False])
def test_a_field_that_keeps_emptying_ends_the_stage(
    fit, tiny_scene: Scene, datamodule: SceneDataModule, mattes: bool
) -> None:
    static, channels = tiny_scene.static, 4 if mattes else 3
    train = replace(static.train, pixels=static.train.pixels[..., :channels].contiguous())
    scene = replace(tiny_scene, static=replace(static, train=train))
    longer = replace(SCHEDULE, iterations=60, doublings=(), rays=128)
    stage = CanonicalStage(longer, replace(SMALL, alpha_init=0.1), iterations_per_step=1)
    with pytest.raises(DevrfError) as caught:
        fit(
            stage,
            Spoil("-100", 20, 40),
            DivergenceGuard(every_iterations=20),
            data=type(datamodule)(scene),  # type: ignore[call-arg]
        )
    said = str(caught.value)
    assert said.startswith("canonical stage: everything has become empty by iteration ")
    assert "data.background" in said and "begin afresh with resume=false" in said
    assert finite(stage.state_dict()) and stage.iteration == 0


@pytest.mark.parametrize("doublings", [(), (10,)])
def test_a_stage_that_never_saw_anything_tells(
    fit, caplog: pytest.LogCaptureFixture, doublings: tuple[int, ...]
) -> None:
    clear, schedule = replace(SMALL, alpha_init=1e-7), replace(SCHEDULE, doublings=doublings)
    stage = CanonicalStage(schedule, clear, rates=CanonicalRates(density=1e-9))
    if doublings:  # nothing to draw pixels from
        with pytest.raises(DevrfError, match="empty by iteration 10: check data.background"):
            fit(stage, DivergenceGuard(every_iterations=20))
        return
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, DivergenceGuard(every_iterations=20))
    assert "canonical: nothing is to be seen at the end (is data.background" in caplog.text
    assert (stage.iteration, stage.num_rollbacks) == (24, 0)


def test_moving_matter_that_leaves_the_picture_without_mattes_is_only_told(
    fit,
    rest: LoadedCheckpoint,
    tiny_scene: Scene,
    datamodule: SceneDataModule,
    caplog: pytest.LogCaptureFixture,
) -> None:
    dynamic = tiny_scene.dynamic
    bare = replace(dynamic.train, pixels=dynamic.train.pixels[..., :3].contiguous())
    scene = replace(tiny_scene, dynamic=replace(dynamic, train=bare))
    schedule = DeformationSchedule(sides=(4,), iterations_per_frame=(40,), rays=64)
    stage = DeformationStage(copy.deepcopy(rest), schedule, iterations_per_step=1)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(
            stage,
            Spoil("100", 45),
            DivergenceGuard(every_iterations=20),
            data=type(datamodule)(scene),  # type: ignore[call-arg]
        )
    assert caplog.text.count("everything has become empty by") == 1
    assert stage.num_rollbacks == 0


def test_a_frame_whose_loss_stands_out_is_told(
    fit, rest: LoadedCheckpoint, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    usual = DeformationStage.loss

    def dear(stage: DeformationStage, *others: Any) -> Any:
        total, terms = usual(stage, *others)
        factor = 50.0 if stage.iteration >= 50 else 1.0
        return total * factor, {**terms, "render": terms["render"] * factor}

    monkeypatch.setattr(DeformationStage, "loss", dear)
    guard = DivergenceGuard()
    schedule = DeformationSchedule(sides=(4,), iterations_per_frame=(20,), rays=64)
    stage = DeformationStage(copy.deepcopy(rest), schedule, iterations_per_step=1)
    seen = {"kind": "level 0", "visited": [0.01, 0.011, 0.012, 0.01]}
    guard.load_state_dict({**guard.state_dict(), **seen})
    monkeypatch.setattr(guard, "_forget", lambda: None)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        fit(stage, guard)
    assert "times that of the frames before" in caplog.text and "(frame 2, " in caplog.text


def test_what_goes_well_is_let_alone(
    fit, rest: LoadedCheckpoint, caplog: pytest.LogCaptureFixture
) -> None:
    def learned(*callbacks: Callback) -> list[dict[str, Any]]:
        stages = [canonical(), DeformationStage(copy.deepcopy(rest), MOVING)]
        torch.manual_seed(4)
        return [fit(stage, *callbacks).state_dict() for stage in stages]

    with caplog.at_level(logging.WARNING, logger="devrf"):
        watched, alone = learned(DivergenceGuard(every_iterations=3)), learned()
    assert caplog.messages == []
    for one, other in zip(watched, alone, strict=True):
        for name, value in one.items():
            if isinstance(value, Tensor):
                assert torch.equal(value, other[name]), name


def test_looking_costs_next_to_nothing(fit, monkeypatch: pytest.MonkeyPatch) -> None:
    spent = [0.0]
    for name in ("on_train_batch_start", "on_train_batch_end"):
        usual = getattr(DivergenceGuard, name)

        def timed(*arguments: Any, usual: Any = usual) -> None:
            began = time.process_time()
            usual(*arguments)
            spent[0] += time.process_time() - began

        monkeypatch.setattr(DivergenceGuard, name, timed)
    schedule = replace(SCHEDULE, iterations=120, side=24, rays=512)
    stage = CanonicalStage(schedule, SMALL)
    began = time.process_time()
    fit(stage, DivergenceGuard())
    assert spent[0] < 0.02 * (time.process_time() - began)


@pytest.mark.parametrize(("every", "factor"), [(0, 0.5), (10, 0.0), (10, 1.5)])
def test_senseless_settings_are_refused(every: int, factor: float) -> None:
    with pytest.raises(DevrfError, match="callbacks.health: expected"):
        DivergenceGuard(every, factor)

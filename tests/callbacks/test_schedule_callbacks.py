"""The schedule's callbacks really act: phases are entered, rates applied, figures kept."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from lightning import Callback, Trainer
from torch.optim import Optimizer

from devrf.callbacks import GridUpscaling, LearningRateDecay, Meter, Progress, TrainingRecord
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings

SMALL = Architecture(channels=4, width=8, frequencies=1)
CANONICAL = CanonicalSchedule(
    search_iterations=0,
    search_side=16,
    carve=True,
    iterations=12,
    side=12,
    doublings=(3, 7),
    decay_iterations=6,
    rays=64,
)
DEFORMATION = DeformationSchedule(sides=(4, 6), iterations_per_frame=(3, 2), rays=64)


class Watch(Callback):
    """Notes iteration, phase and rates at each optimiser step, after the other callbacks."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, Any, list[float]]] = []

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: Any, optimizer: Optimizer
    ) -> None:
        rates = [group["lr"] for group in optimizer.param_groups]
        self.steps.append((pl_module.iteration, pl_module.phase, rates))


def test_canonical_rates_and_phases_are_the_schedules_at_every_step(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    watch = Watch()
    trainer(watch, max_epochs=1).fit(CanonicalStage(CANONICAL, SMALL), datamodule=datamodule)
    assert [step for step, _, _ in watch.steps] == list(range(12))
    for step, phase, rates in watch.steps:
        assert phase == CANONICAL.phase(step)
        factor = 0.1 ** (step / 6)
        assert rates == pytest.approx([0.1 * factor, 0.1 * factor, 1e-3 * factor])


@pytest.mark.parametrize("unit", ["world", "box"])
def test_deformation_rates_and_phases_are_the_schedules_at_every_step(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: Callable[..., Trainer], unit: Any
) -> None:
    watch, motion = Watch(), MotionSettings(learning_rate=2e-3, unit=unit)
    stage = DeformationStage(rest, DEFORMATION, motion)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert [step for step, _, _ in watch.steps] == list(range(15))
    # Three frames, shares of 3 and 2; frame 1 has two shares.
    visits = [(phase.level, *phase.frames) for _, phase, _ in watch.steps]
    assert visits == [(0, 1)] * 6 + [(0, 2)] * 3 + [(1, 1)] * 4 + [(1, 2)] * 2
    scale = stage.field.box.longest if unit == "box" else 1.0
    for _, phase, rates in watch.steps:
        assert rates == pytest.approx([2e-3 * scale * 10 ** (-phase.level / 4)])
    assert stage.resolution == stage.field.box.grid_shape(6**3)


def test_without_the_upscaling_callback_a_stage_says_what_is_missing(
    datamodule: SceneDataModule,
) -> None:
    bare = Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        max_steps=1,
        callbacks=[LearningRateDecay()],
    )
    with pytest.raises(DevrfError, match="CanonicalStage.*iteration 0.*GridUpscaling"):
        bare.fit(CanonicalStage(CANONICAL, SMALL), datamodule=datamodule)


def test_the_record_says_what_training_took(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    stage = CanonicalStage(CANONICAL, SMALL)
    trainer(TrainingRecord(), max_epochs=1).fit(stage, datamodule=datamodule)
    assert stage.record["iterations"] == 12
    assert stage.record["peak_gpu_gb"] is None
    seconds = stage.record["seconds"]
    assert seconds is not None and 0 < seconds < 60
    speed = stage.record["iterations_per_second"]
    assert speed is not None and 12 / speed == pytest.approx(seconds, abs=0.01)
    assert stage.metadata().records["canonical"] == stage.record


def test_progress_writes_lines_where_there_is_no_terminal(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage = DeformationStage(rest, DEFORMATION, iterations_per_step=100)
    with caplog.at_level(logging.INFO, logger="devrf"):
        fit = trainer(Progress(line_every_seconds=0.0), max_epochs=1)
        fit.fit(stage, datamodule=datamodule)
    lines = [line for line in caplog.messages if line.startswith("dynamic ")]
    # A line at the end of each phase: 6, 9, 13 and 15 iterations.
    assert [line.split()[1] for line in lines] == ["6/15", "9/15", "13/15", "15/15"]
    shape = "x".join(str(n) for n in stage.resolution)
    assert "dB" in lines[-1] and "it/s" in lines[-1]
    assert lines[-1].endswith(f"{shape}  frame 2")


def test_progress_and_curves_name_the_frames_of_a_visit(
    rest: LoadedCheckpoint,
    four_frames: SceneDataModule,
    trainer: Callable[..., Trainer],
    caplog: pytest.LogCaptureFixture,
) -> None:
    schedule = replace(DEFORMATION, coarse_to_fine=False, parallel_frames=(1, 2))
    stage = DeformationStage(rest, schedule, iterations_per_step=100)
    with caplog.at_level(logging.INFO, logger="devrf"):
        fit = trainer(Progress(line_every_seconds=0.0), Meter(), max_epochs=1)
        fit.fit(stage, datamodule=four_frames)
    lines = [line for line in caplog.messages if line.startswith("dynamic ")]
    assert [line.split("  ")[-1] for line in lines] == ["frame 2", "frames 1, 3"]
    assert fit.callback_metrics["dynamic/frame"] == 1


def test_phases_are_entered_once(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = CanonicalStage(CANONICAL, SMALL, iterations_per_step=1)
    entered: list[Any] = []
    enter = stage.enter

    def noted(phase: Any) -> None:
        entered.append(phase)
        enter(phase)

    monkeypatch.setattr(stage, "enter", noted)
    fit = trainer(max_epochs=1)
    assert any(isinstance(c, GridUpscaling) for c in fit.callbacks)  # type: ignore[attr-defined]
    fit.fit(stage, datamodule=datamodule)
    assert entered == list(CANONICAL.phases)

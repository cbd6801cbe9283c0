"""The schedule's callbacks really act: phases are entered, rates applied, figures kept."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import LambdaCallback
from torch.optim import Optimizer

from devrf.callbacks import Meter, Progress, TrainingRecord
from devrf.engine.schedule import cost
from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import VisitSettings

DEFORMATION = DeformationSchedule(levels=(Level(4, 3), Level(6, 2)), rays=64)


def watched(steps: list[tuple[int, Any, list[float]]]) -> Callback:
    """Notes iteration, phase and rates at each optimiser step, after the other callbacks."""

    def note(trainer: Trainer, stage: Any, optimizer: Optimizer) -> None:
        rates = [group["lr"] for group in optimizer.param_groups]
        steps.append((stage.position.iteration, stage.phase, rates))

    return LambdaCallback(on_before_optimizer_step=note)


def test_canonical_rates_and_phases_are_the_schedules_at_every_step(fit, canonical):
    stage = fit(canonical(iterations_per_step=10), watched(steps := []))
    assert [step for step, _, _ in steps] == list(range(12))
    for step, phase, rates in steps:
        assert phase == stage.schedule.phase(step)
        factor = 0.1 ** ((step - phase.start) / 6)
        assert rates == pytest.approx([0.1 * factor, 0.1 * factor, 1e-3 * factor])


def test_deformation_rates_and_phases_are_the_schedules_at_every_step(fit, rest):
    visit = VisitSettings(learning_rate=2e-3, unit="box")
    stage = fit(DeformationStage(rest, DEFORMATION, visit), watched(steps := []))
    assert [step for step, _, _ in steps] == list(range(15))
    # Three frames, shares of 3 and 2; frame 1 has two shares.
    visits = [(phase.level, phase.frame) for _, phase, _ in steps]
    assert visits == [(0, 1)] * 6 + [(0, 2)] * 3 + [(1, 1)] * 4 + [(1, 2)] * 2
    scale = stage.field.box.longest
    for _, phase, rates in steps:
        assert rates == pytest.approx([2e-3 * scale * 10 ** (-phase.level / 4)])
    assert stage.scene_model.resolution == stage.field.box.grid_shape(6**3)


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        (0, r"^CanonicalStage: .*iteration 0.*GridUpscaling"),
        (1, r"^CanonicalStage: the learning rates .*LearningRateDecay"),
    ],
)
def test_without_a_callback_of_the_schedule_a_stage_says_what_is_missing(
    canonical, datamodule, trainer, left_out, said
):
    bare, stage = trainer(max_steps=1), canonical()
    bare.callbacks.pop(left_out)  # type: ignore[attr-defined]
    with pytest.raises(DevrfError, match=said):
        bare.fit(stage, datamodule=datamodule)
    assert stage.position.iteration == 0


def test_the_record_says_what_training_took(fit, canonical):
    stage = fit(canonical(), TrainingRecord())
    record = stage.provenance.record
    assert record["iterations"] == 12
    assert record["peak_gpu_gb"] is None and record["peak_reserved_gb"] is None
    seconds, speed = record["seconds"], record["iterations_per_second"]
    assert 0 < seconds < 60 and 12 / speed == pytest.approx(seconds, abs=0.01)
    assert stage.result().metadata.records["canonical"] == record


def test_progress_and_curves_name_the_frame_of_a_visit(rest, four_frames, trainer, caplog):
    caplog.set_level(logging.INFO, logger="devrf")
    schedule = replace(DEFORMATION, levels=(Level(6, 5),))
    stage = DeformationStage(rest, schedule, iterations_per_step=100)
    fitted = trainer(Progress(line_every_seconds=0.0), Meter(), max_epochs=1)
    fitted.fit(stage, datamodule=four_frames)
    lines = [line for line in caplog.messages if line.startswith("dynamic ")]
    first, *_, last = (line.split("  ") for line in lines)
    assert first[-2] == "frame 1" and re.fullmatch(r"about \d+ (s|min) left", first[-1])
    assert last[-1] == "frame 3"  # nothing is left
    assert " dB" in lines[-1]
    assert fitted.callback_metrics["dynamic/frame"] == 3


def test_the_time_left_knows_that_finer_levels_take_longer(fit, canonical, caplog, monkeypatch):
    stage = canonical(upsample_at=(2, 3, 4))
    # Sides of 6 for two iterations, of 12 for the last eight.
    costs = (cost(stage.schedule, 0, 2), cost(stage.schedule, 4, 12))
    assert costs == pytest.approx((2 * 6, 8 * 12))
    # Every iteration takes a second so far: each of the last eight will take two.
    clock = SimpleNamespace(perf_counter=map(float, count()).__next__)
    monkeypatch.setattr("devrf.callbacks.progress.time", clock)
    caplog.set_level(logging.INFO, logger="devrf")
    fit(stage, Progress(line_every_seconds=0.0))
    first = next(line for line in caplog.messages if line.startswith("static 1/12"))
    # (6 + 7.6 + 9.5 + 8 · 12) / 6, not 11 s
    assert first.endswith("  about 20 s left")


def test_a_callback_of_ones_own_sets_the_rates_as_the_page_shows(canonical, datamodule, trainer):
    page = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
    section = page.split("{ #schedule-callbacks }")[1]
    names: dict[str, Any] = {}
    exec(section.split("```python\n")[1].split("```")[0], names)
    rates = []
    watch = LambdaCallback(
        on_train_batch_end=lambda trainer, stage, *_: rates.append(
            stage.optimizer.param_groups[0]["lr"] / stage.optimizer.param_groups[0]["base_lr"]
        )
    )
    stage = canonical(iterations=20, upsample_at=(), decay_iterations=10**6)
    fitted = trainer(names["RampedDecay"](), watch, max_epochs=1)
    fitted.fit(stage, datamodule=datamodule)
    assert rates == pytest.approx([1.0] * 19 + [0.5], abs=1e-4)

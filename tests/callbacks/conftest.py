"""Small stages, and a way to fit them with callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lightning import Callback, Trainer

from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.settings import CanonicalRates

SCHEDULE = CanonicalSchedule(
    search_iterations=0,
    search_side=12,
    carve=True,
    iterations=12,
    side=12,
    doublings=(3, 7),
    decay_iterations=6,
    rays=64,
)
Canonical = Callable[..., CanonicalStage]
Fit = Callable[..., Any]


@pytest.fixture
def canonical() -> Canonical:
    """``canonical(**changes)``: a stage of 12 iterations; changes of its schedule and field."""

    def build(
        alpha_init: float = 0.01,
        rates: CanonicalRates | None = None,
        iterations_per_step: int = 1,
        **changes: Any,
    ) -> CanonicalStage:
        field = Architecture(channels=4, width=8, frequencies=1, alpha_init=alpha_init)
        schedule = replace(SCHEDULE, **changes)
        return CanonicalStage(schedule, field, rates, iterations_per_step=iterations_per_step)

    return build


@pytest.fixture
def fit(datamodule: SceneDataModule, trainer: Callable[..., Trainer]) -> Fit:
    """``fit(stage, *callbacks)``: the stage, fitted; no row of the curves is due before the end."""

    def learn(
        stage: ScheduledStage,
        *callbacks: Callback,
        data: SceneDataModule = datamodule,
        ckpt_path: Path | None = None,
        every: int = 1000,
    ) -> ScheduledStage:
        made = trainer(*callbacks, max_epochs=1, log_every_n_steps=every)
        made.strategy.checkpoint_io = ChecksummedCheckpointIO()
        made.fit(stage, datamodule=data, ckpt_path=ckpt_path and str(ckpt_path))
        return stage

    return learn

"""Stages of a few iterations on the tiny scene, and what they have learned: fixtures."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from devrf.callbacks import GridUpscaling, LearningRateDecay
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import Stage
from devrf.geometry.clock import FrameClock
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.extensions.color_residual import ColorResidualGrid
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import CanonicalRates
from devrf.scenes.scene import Scene
from tiny_scenes import GivenScene


def quiet_trainer(*callbacks: Callback, **options: Any) -> Trainer:
    """A trainer on the CPU with the two callbacks that a schedule needs, and no files."""
    warnings.filterwarnings("ignore", module="lightning")
    quiet: dict[str, Any] = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "limit_val_batches": 0,
        "num_sanity_val_steps": 0,
    }
    schedule = [GridUpscaling(), LearningRateDecay()]
    return Trainer(
        accelerator="cpu", devices=1, callbacks=[*schedule, *callbacks], **{**quiet, **options}
    )


@pytest.fixture
def trainer() -> Callable[..., Trainer]:
    """The function :func:`quiet_trainer`."""
    return quiet_trainer


@pytest.fixture
def fit(datamodule: SceneDataModule, trainer: Callable[..., Trainer]) -> Callable[..., Stage]:
    """``fit(stage, *callbacks)``: the stage, fitted; no row of the curves is due before the end."""

    def learn(
        stage: Stage,
        *callbacks: Callback,
        data: SceneDataModule = datamodule,
        ckpt_path: Path | None = None,
        every: int = 1000,
    ) -> Stage:
        fitted = trainer(*callbacks, max_epochs=1, log_every_n_steps=every)
        fitted.fit(stage, datamodule=data, ckpt_path=ckpt_path and str(ckpt_path))
        return stage

    return learn


@pytest.fixture
def canonical() -> Callable[..., CanonicalStage]:
    """``canonical(**changes)``: a stage of 12 iterations; changes of its schedule and field."""
    schedule = CanonicalSchedule(
        search_iterations=0,
        search_side=12,
        visual_hull_init=True,
        iterations=12,
        side=12,
        upsample_at=(3, 7),
        decay_iterations=6,
        density_drop=0.0,
        rays=64,
    )

    def build(
        alpha_init: float = 0.01,
        rates: CanonicalRates | None = None,
        iterations_per_step: int = 1,
        **changes: Any,
    ) -> CanonicalStage:
        field = Architecture(channels=4, width=8, frequencies=1, alpha_init=alpha_init)
        changed = replace(schedule, **changes)
        return CanonicalStage(changed, field, rates, iterations_per_step=iterations_per_step)

    return build


SMALL = Architecture(channels=4, width=16, frequencies=2)


@pytest.fixture(scope="session")
def learned(tiny_scene: Scene) -> tuple[CanonicalStage, Trainer]:
    """The tiny scene at rest, learned in under a second; not to be changed."""
    torch.manual_seed(0)
    schedule = CanonicalSchedule(
        search_iterations=0,
        search_side=16,
        visual_hull_init=True,
        iterations=120,
        side=20,
        upsample_at=(40,),
        density_drop=0.0,
        rays=256,
    )
    stage = CanonicalStage(schedule, SMALL)
    fitted = quiet_trainer(max_epochs=1)
    fitted.fit(stage, datamodule=GivenScene(tiny_scene))
    return stage, fitted


@pytest.fixture
def rest(learned: tuple[CanonicalStage, Trainer]) -> LoadedCheckpoint:
    """A copy of the tiny scene at rest, for a deformation stage to build on."""
    return copy.deepcopy(learned[0].result())


@pytest.fixture
def moving(learned: tuple[CanonicalStage, Trainer], rng: torch.Generator) -> DeVRFModel:
    """The tiny scene; at the times 0.4 and 1 every point has moved by up to 5 % of its box.

    Its colours have changed, too.
    """
    model = copy.deepcopy(learned[0].scene_model)
    box = model.canonical.box
    deformation = DeformationField(box, FrameClock((0.0, 0.4, 1.0)), voxels=5**3)
    shape = deformation.backward_slices[1:].shape
    deformation.backward_slices[1:] = 0.1 * box.longest * (torch.rand(shape, generator=rng) - 0.5)
    model.deformation = deformation
    model.color_residual = ColorResidualGrid(box, deformation.clock, voxels=4**3)
    shape = model.color_residual.values[1:].shape
    model.color_residual.values[1:] = 2 * torch.rand(shape, generator=rng) - 1
    return model

"""A profiler sees the parts of an iteration; without one they cost nothing."""

from __future__ import annotations

from typing import get_args

from lightning import Trainer
from torch.profiler import ProfilerActivity, profile

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.system.profiling import Part


def test_training_does_every_part(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: type[Trainer]
) -> None:
    schedule = DeformationSchedule(levels=(Level(4, 2),), rays=64)
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        trainer(max_steps=2).fit(DeformationStage(rest, schedule), datamodule=datamodule)
    assert set(get_args(Part)) <= {event.name for event in profiled.events()}

"""The page of the architecture names the files that an iteration passes through."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from lightning import Trainer
from torch import Tensor

import devrf
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import Stage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage

SOURCE = Path(devrf.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"


def test_an_iteration_enters_the_files_that_are_listed_in_their_order(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: Any,
) -> None:
    entered: dict[str, None] = {}  # in the order in which they are entered first

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(SOURCE):
            entered[str(path.relative_to(SOURCE))] = None

    step = Stage.training_step

    def noted(stage: Stage, *arguments: Any) -> dict[str, Tensor]:
        before = sys.getprofile()
        sys.setprofile(note if stage.position.iteration == 3 else before)
        try:
            return step(stage, *arguments)
        finally:
            sys.setprofile(before)

    monkeypatch.setattr(Stage, "training_step", noted)
    schedule = DeformationSchedule((Level(4, 4),), rays=64)
    stage = DeformationStage(rest, schedule, iterations_per_step=1)
    trainer(max_steps=5).fit(stage, datamodule=datamodule)
    section = PAGE.read_text().split("{ #one-iteration }")[1]
    listed = re.findall(r"`((?:engine|methods/devrf|kernels)/\w+\.py)`", section)
    inner = [n for n in entered if n.startswith(("engine/", "methods/devrf/", "kernels/"))]
    assert inner == listed

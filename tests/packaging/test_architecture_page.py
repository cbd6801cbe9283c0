"""The page of the architecture names the files that an iteration passes through."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from lightning import Trainer

import devrf
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.loop import Loop
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage

SOURCE = Path(devrf.__file__).parent
PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"


def test_an_iteration_enters_the_files_that_are_listed(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: Any,
) -> None:
    entered: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(SOURCE):
            entered.add(str(path.relative_to(SOURCE)))

    step = Loop.step

    def noted(loop: Loop, stage: Any, *arguments: Any) -> None:
        before = sys.getprofile()
        sys.setprofile(note if stage.iteration == 3 else before)
        try:
            stage.prepare()
            step(loop, stage, *arguments)
        finally:
            sys.setprofile(before)

    monkeypatch.setattr(Loop, "step", noted)
    stage = DeformationStage(rest, DeformationSchedule((Level(4, 4),), rays=64))
    trainer(max_steps=5).fit(stage, datamodule=datamodule)
    section = PAGE.read_text().split("{ #one-iteration }")[1]
    listed = set(re.findall(r"`((?:engine|methods/devrf)/\w+\.py)`", section))
    inner = {name for name in entered if name.startswith(("engine/", "methods/devrf/"))}
    # Lightning's step is around the iteration.
    assert inner | {"engine/stage.py"} == listed

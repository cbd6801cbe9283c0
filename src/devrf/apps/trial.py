"""How long learning will take on this machine, told from a few seconds of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from lightning import LightningModule, Trainer

from devrf.callbacks.schedule import GridUpscaling, LearningRateDecay
from devrf.data.datamodule import SceneDataModule
from devrf.engine.schedule import cost
from devrf.engine.stage import Stage
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule


class Trial(GridUpscaling):
    """Takes a stage through its schedule for some seconds.

    Attributes:
        most_seconds: after which it ends; the first step, which warms up, does not count.
        pace: the cost of iterations in a second (:func:`~devrf.engine.schedule.cost`).
    """

    def __init__(self, most_seconds: float = 10.0) -> None:
        self.most_seconds = most_seconds
        self.pace = 0.0
        self._began: tuple[float, int] | None = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Begin to count; stop when the time is over."""
        assert isinstance(pl_module, Stage)
        now = time.perf_counter()
        done = pl_module.iteration
        began, first = self._began = self._began or (now, done)
        if done > first:
            self.pace = cost(pl_module.timeline, first, done) / (now - began)
            trainer.should_stop = now - began >= self.most_seconds


def seconds_to_learn(
    stage: Stage,
    moving: DeformationSchedule,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
) -> float:
    """How long both stages will take, by a trial of the canonical one with such a ``trainer``.

    A batch of the deformation stage takes as long as one of as many rays at the end of the
    canonical stage.
    """
    assert isinstance(stage, CanonicalStage)
    trial = Trial()
    trainer(callbacks=[trial, LearningRateDecay()], logger=False).fit(stage, datamodule=datamodule)
    end = stage.timeline.total
    frames = len(datamodule.scene.clock)
    batches = moving.total(frames) * moving.rays / stage.schedule.rays if frames > 1 else 0
    moving_cost = batches * stage.timeline.phase(end).cost
    return (cost(stage.timeline, 0, end) + moving_cost) / trial.pace

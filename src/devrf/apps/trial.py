"""An estimate of the time that learning takes on this machine, from a few seconds of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from lightning import LightningModule, Trainer

from devrf.callbacks.schedule import GridUpscaling, LearningRateDecay
from devrf.data.datamodule import SceneDataModule
from devrf.engine.schedule import cost
from devrf.engine.stage import Stage


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
        done = pl_module.position.iteration
        began, first = self._began = self._began or (now, done)
        if done > first:
            self.pace = cost(pl_module.schedule, first, done) / (now - began)
            trainer.should_stop = now - began >= self.most_seconds


def seconds_to_learn(
    stage: Stage,
    later: Sequence[tuple[int, int]],
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
) -> float:
    """How long all stages will take, by a trial of the first one with such a ``trainer``.

    A batch of a later stage takes as long as one of as many rays at the end of the first.

    Args:
        stage: the first.
        later: the iterations and rays of the others.
        datamodule: serves the scene.
        trainer: makes one, given callbacks and a logger.
    """
    trial = Trial()
    trainer(callbacks=[trial, LearningRateDecay()], logger=False).fit(stage, datamodule=datamodule)
    schedule: Any = stage.schedule
    end: int = schedule.total
    batches = sum(iterations * rays for iterations, rays in later) / schedule.rays
    seconds: float = (cost(schedule, 0, end) + batches * schedule.phase(end).cost) / trial.pace
    return seconds

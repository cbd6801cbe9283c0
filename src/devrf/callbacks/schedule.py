"""The callbacks that carry out a stage's schedule."""

from __future__ import annotations

from typing import Any, cast

from lightning import Callback, LightningModule, Trainer
from torch.optim import Optimizer

from devrf.engine.schedule import Scheduled


class GridUpscaling(Callback):
    """Takes a stage into the next phase of its schedule: finer grids, the next frame."""

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Enter the phase of the coming iteration, if it is another one."""
        stage = cast(Scheduled, pl_module)
        phase = stage.schedule.phase(stage.position.iteration)
        if phase != stage.phase:
            stage.enter(phase)


class LearningRateDecay(Callback):
    """Scales every learning rate by the schedule's factor, before each optimiser step."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Tell the stage, which refuses to learn at rates that nobody sets."""
        cast(Scheduled, pl_module).has_scheduled_rates = True

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Set ``lr`` to ``base_lr`` times the iteration's factor and the stage's ``lr_scale``.

        The factor has the power ``decay`` of a group that has one.
        """
        stage = cast(Scheduled, pl_module)
        position = stage.position
        factor = stage.schedule.learning_rate_factor(position.iteration)
        for group in optimizer.param_groups:
            decayed = factor ** group.get("decay", 1.0)
            group["lr"] = group["base_lr"] * decayed * position.lr_scale

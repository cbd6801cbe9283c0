"""The callbacks that apply a stage's schedule."""

from __future__ import annotations

from typing import Any

from lightning import Callback, LightningModule, Trainer
from torch.optim import Optimizer

from devrf.engine.stage import Stage


class GridUpscaling(Callback):
    """Takes a stage into the next phase of its schedule: finer grids, the next frame."""

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Enter the phase of the coming iteration, if it is another one."""
        assert isinstance(pl_module, Stage)
        phase = pl_module.phase_at(pl_module.iteration)
        if phase != pl_module.phase:
            pl_module.enter(phase)


class LearningRateDecay(Callback):
    """Scales every learning rate by the schedule's factor, before each optimiser step."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Tell the stage, which refuses to learn at rates that nobody sets."""
        assert isinstance(pl_module, Stage)
        pl_module.has_scheduled_rates = True

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Set ``lr`` to ``base_lr`` times the iteration's factor and the stage's ``lr_scale``."""
        assert isinstance(pl_module, Stage)
        factor = pl_module.learning_rate_factor(pl_module.iteration) * pl_module.lr_scale
        for group in optimizer.param_groups:
            group["lr"] = group["base_lr"] * factor

"""Looks at a held-out view now and then while a stage learns."""

from __future__ import annotations

import math
from typing import Any

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn

from devrf.engine.stage import Stage
from devrf.loggers.trackers import trackers
from devrf.pictures.held_out import preview
from devrf.system.options import Count


class Previews(Callback):
    """Has Lightning validate a stage ``times`` times, and shows the first view to trackers.

    A trainer with a ``val_check_interval`` of its own validates as that says. How many views are
    scored is the trainer's ``limit_val_batches``.

    Attributes:
        psnr: (iterations done, dB) of the validations of the present stage.
    """

    def __init__(self, times: Count = 6) -> None:
        """``times``: of each stage, evenly spread, the last at its end."""
        self.times = times
        self.psnr: list[tuple[int, float]] = []
        self._shown = 0
        self._own = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before; validate by steps, which callbacks that are set up later see.

        ``EarlyStopping`` and ``ModelCheckpoint`` then look after each validation, in place of after
        the epoch, of which a stage has one.
        """
        if stage == "fit":
            self.psnr = []
            self._own = trainer.val_check_interval != 1.0
            if not self._own:
                trainer.check_val_every_n_epoch = None

    def state_dict(self) -> dict[str, Any]:
        """The PSNR of the validations so far."""
        return {"psnr": list(self.psnr)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave."""
        self.psnr = [(int(k), float(value)) for k, value in state_dict["psnr"]]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        assert isinstance(pl_module, Stage)
        self._shown = self._due(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Ask Lightning to validate after this step, if that is due."""
        assert isinstance(pl_module, Stage)
        if not self._own:
            due = self._due(pl_module)
            trainer.val_check_batch = 1 if due != self._shown else math.inf
            self._shown = due

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Show the first view."""
        assert isinstance(pl_module, Stage)
        if batch_idx or trainer.sanity_checking or trainer.state.fn != TrainerFn.FITTING:
            return
        view = outputs["view"]
        done = pl_module.position.iterations_done
        self.psnr = [point for point in self.psnr if point[0] < done] + [(done, view.psnr)]
        for tracker in trackers(trainer.loggers):
            for name, image in preview(view).items():
                tracker.show_image(f"{pl_module.capture}/{name}", image, done)

    def _due(self, stage: Stage) -> int:
        return stage.position.iteration * self.times // stage.schedule.total

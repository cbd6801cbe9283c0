"""Pictures of a held-out view while a stage learns."""

from __future__ import annotations

import time
from typing import Any

from lightning import Callback, LightningModule, Trainer

from devrf.apps.still import preview
from devrf.apps.trackers import trackers
from devrf.engine.stage import ScheduledStage


class Previews(Callback):
    """Shows the held-out view in the middle of the recording, where a logger takes pictures.

    Attributes:
        seconds: what the pictures of the present stage have taken.
        psnr: (iteration, dB) of the pictures of the present stage.
    """

    def __init__(self, times: int = 6) -> None:
        """``times``: pictures of each stage, evenly spread, the last at its end."""
        self.times = times
        self.seconds = 0.0
        self.psnr: list[tuple[int, float]] = []
        self._shown = 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Forget the stage before."""
        self.psnr = []

    def state_dict(self) -> dict[str, Any]:
        """The PSNR of the pictures so far."""
        return {"psnr": list(self.psnr)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with what :meth:`state_dict` gave."""
        self.psnr = [(int(k), float(value)) for k, value in state_dict["psnr"]]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin to count."""
        assert isinstance(pl_module, ScheduledStage)
        self.seconds, self._shown = 0.0, self._due(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Show the view, if a picture is due."""
        assert isinstance(pl_module, ScheduledStage)
        due = self._due(pl_module)
        if due == self._shown or not trainer.is_global_zero:
            return
        self._shown = due
        started = time.perf_counter()
        if found := trackers(trainer.loggers):
            views = pl_module.scene.capture(pl_module.scored_capture).test
            seen = preview(
                pl_module.current_model(), views, len(views) // 2, pl_module.scene.background
            )
            done, capture = pl_module.iteration, pl_module.capture
            self.psnr = [point for point in self.psnr if point[0] < done] + [(done, seen.psnr)]
            for tracker in found:
                for name, image in seen.images.items():
                    tracker.show_image(f"{capture}/{name}", image, done)
            for logger in trainer.loggers:
                logger.log_metrics({f"{capture}/held_out_psnr": seen.psnr}, done)
        self.seconds += time.perf_counter() - started

    def _due(self, stage: ScheduledStage) -> int:
        return stage.iteration * self.times // stage.total_iterations

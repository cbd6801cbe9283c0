"""A progress bar with iteration, PSNR, speed, resolution and frame."""

from __future__ import annotations

import logging
import math
import time
from typing import Any

from lightning import Callback, LightningModule, Trainer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from devrf.engine.phase import in_words
from devrf.engine.stage import ScheduledStage

log = logging.getLogger(__name__)

# Each update reads one number from the device.
BAR_EVERY_SECONDS = 0.5


class Progress(Callback):
    """Shows a bar on a terminal, else a line every ``line_every_seconds``."""

    def __init__(self, line_every_seconds: float = 15.0) -> None:
        self.line_every_seconds = line_every_seconds
        self._bar: Bar | None = None
        self._shown = (0.0, 0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar."""
        assert isinstance(pl_module, ScheduledStage)
        if not trainer.is_global_zero:
            return
        self._shown = (time.perf_counter(), pl_module.iteration)
        console = Console()
        if console.is_terminal:
            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=console,
            )
            self._bar.add_task(
                type(pl_module).__name__,
                total=pl_module.total_iterations,
                completed=pl_module.iteration,
                state="",
            )
            self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Update the bar or write a line, if it is due."""
        assert isinstance(pl_module, ScheduledStage)
        now = time.perf_counter()
        since, done = now - self._shown[0], pl_module.iteration
        if since < (self.line_every_seconds if self._bar is None else BAR_EVERY_SECONDS):
            return
        state = describe(trainer, pl_module, (done - self._shown[1]) / since)
        self._shown = (now, done)
        if self._bar is None:
            log.info("%s %d/%d  %s", pl_module.capture, done, pl_module.total_iterations, state)
        else:
            self._bar.update(self._bar.task_ids[0], completed=done, state=state)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Close the bar."""
        self._close()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Close the bar, so that the message begins on a new line."""
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self._shown[1])
            self._bar.stop()
            self._bar = None


def describe(trainer: Trainer, stage: ScheduledStage, speed: float) -> str:
    """PSNR of the last batches, iterations a second, resolution, and the frames if any."""
    means = trainer.callback_metrics
    error = means.get(f"{stage.capture}/color", means.get(f"{stage.capture}/render"))
    parts = [] if error is None else [f"{-10 * math.log10(max(float(error), 1e-12)):.1f} dB"]
    parts.append(f"{speed:.0f} it/s")
    if stage.resolution:
        parts.append("x".join(str(n) for n in stage.resolution))
    if stage.phase is not None and stage.phase.frames:
        parts.append(in_words(stage.phase.frames))
    return "  ".join(parts)

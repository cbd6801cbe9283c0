"""A progress bar with iteration, PSNR, speed, resolution, frame and the time left."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from lightning import Callback, LightningModule, Trainer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from torch import Tensor

from devrf.callbacks.curves import batch_psnr
from devrf.engine.stage import Stage
from devrf.system.progress import time_left

log = logging.getLogger(__name__)

# Each update reads one number from the device.
BAR_EVERY_SECONDS = 0.5
# The weight of the latest line's pace in the pace that gives the time left.
LATEST = 0.4


class Progress(Callback):
    """Shows a bar on a terminal, else a line every ``line_every_seconds``.

    The time left comes from the pace so far and from what the phases to come cost
    (:meth:`~devrf.engine.stage.Stage.cost`).
    """

    def __init__(self, line_every_seconds: float = 15.0) -> None:
        self.line_every_seconds = line_every_seconds
        self._bar: Bar | None = None
        self._shown = (0.0, 0)
        self._pace = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar."""
        assert isinstance(pl_module, Stage)
        if not trainer.is_global_zero:
            return
        self._shown = (time.perf_counter(), pl_module.iteration)
        self._pace = 0.0
        console = Console()
        if console.is_terminal:
            self._bar = Bar(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[state]}"),
                TimeRemainingColumn(),
                console=console,
            )
            self._bar.add_task(
                type(pl_module).__name__,
                total=pl_module.cost(0, pl_module.total_iterations),
                completed=int(pl_module.cost(0, pl_module.iteration)),
                state="",
            )
            self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Update the bar or write a line, if it is due."""
        assert isinstance(pl_module, Stage)
        now = time.perf_counter()
        since = now - self._shown[0]
        done = pl_module.iteration
        if since < (self.line_every_seconds if self._bar is None else BAR_EVERY_SECONDS):
            return
        before = self._shown[1]
        total = pl_module.total_iterations
        speed = (done - before) / since
        pace = pl_module.cost(before, done) / since
        self._shown = (now, done)
        if self._bar is None:
            self._pace = pace if self._pace == 0 else self._pace + LATEST * (pace - self._pace)
            log.info("%s", in_one_line(outputs or {}, pl_module, speed, self._pace))
        else:
            state = f"{done}/{total}  {describe(outputs or {}, pl_module, speed)}"
            completed = pl_module.cost(0, done)
            self._bar.update(self._bar.task_ids[0], completed=completed, state=state)

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
            self._bar.stop()
            self._bar = None


def in_one_line(means: Mapping[str, Tensor], stage: Stage, speed: float, pace: float) -> str:
    """Where a stage is, what :func:`describe` says, and the time left.

    ``speed`` is in iterations a second, ``pace`` in their cost, which levels to come have more of.
    """
    done = stage.iteration
    total = stage.total_iterations
    left = f"  {time_left(stage.cost(done, total) / pace)}" if 0 < pace and done < total else ""
    return f"{stage.capture} {done}/{total}  {describe(means, stage, speed)}{left}"


def describe(means: Mapping[str, Tensor], stage: Stage, speed: float) -> str:
    """PSNR of the last batches, iterations a second, resolution, and the frame if any."""
    psnr = batch_psnr(means)
    parts = [] if psnr is None else [f"{float(psnr):.1f} dB"]
    parts.append(f"{speed:.0f} it/s" if speed >= 10 else f"{speed:.2g} it/s")
    if stage.resolution:
        parts.append("x".join(str(n) for n in stage.resolution))
    if stage.phase is not None and stage.phase.frame is not None:
        parts.append(f"frame {stage.phase.frame}")
    return "  ".join(parts)

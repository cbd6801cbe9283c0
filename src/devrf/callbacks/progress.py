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

from devrf.engine.schedule import share_done
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
    (:func:`~devrf.engine.schedule.cost`).
    """

    def __init__(self, line_every_seconds: float = 15.0) -> None:
        self.line_every_seconds = line_every_seconds
        self._bar: Bar | None = None
        # Seconds, iterations carried out, and the share of the schedule that was over.
        self._shown = (0.0, 0, 0.0)
        self._pace = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar."""
        assert isinstance(pl_module, Stage)
        if not trainer.is_global_zero:
            return
        self._shown = self._now(pl_module)
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
                total=1.0,
                state="",
            )
            self._bar.update(self._bar.task_ids[0], completed=self._shown[2])
            self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Update the bar or write a line, if it is due."""
        assert isinstance(pl_module, Stage)
        before = self._shown
        since = time.perf_counter() - before[0]
        if since < (self.line_every_seconds if self._bar is None else BAR_EVERY_SECONDS):
            return
        self._shown = now = self._now(pl_module)
        speed = (now[1] - before[1]) / since
        pace = (now[2] - before[2]) / since
        if self._bar is None:
            self._pace = pace if self._pace == 0 else self._pace + LATEST * (pace - self._pace)
            line = in_one_line(outputs or {}, pl_module, speed, share=now[2], pace=self._pace)
            log.info("%s", line)
        else:
            place = f"{pl_module.position.iteration}/{pl_module.schedule.total}"
            at = f"{place}  {describe(outputs or {}, pl_module, speed)}"
            self._bar.update(self._bar.task_ids[0], completed=now[2], state=at)

    @staticmethod
    def _now(stage: Stage) -> tuple[float, int, float]:
        done = stage.position.iterations_done
        return time.perf_counter(), done, share_done(stage.schedule, stage.position.iteration)

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


def in_one_line(
    means: Mapping[str, Tensor], stage: Stage, speed: float, share: float, pace: float
) -> str:
    """Where a stage is, what :func:`describe` says, and the time left.

    ``speed`` is in iterations a second, ``share`` the part of the whole schedule's duration that
    is over, ``pace`` how much more of it a second.
    """
    left = 1 - share
    ends = f"  {time_left(left / pace)}" if pace > 0 and left > 0 else ""
    place = f"{stage.capture} {stage.position.iteration}/{stage.schedule.total}"
    return f"{place}  {describe(means, stage, speed)}{ends}"


def describe(means: Mapping[str, Tensor], stage: Stage, speed: float) -> str:
    """PSNR of the last batches, iterations a second, resolution, and the frame if any."""
    psnr = means.get("psnr")
    parts = [] if psnr is None else [f"{float(psnr):.1f} dB"]
    parts.append(f"{speed:.0f} it/s" if speed >= 10 else f"{speed:.2g} it/s")
    if stage.scene_model.resolution:
        parts.append("x".join(str(n) for n in stage.scene_model.resolution))
    if stage.phase is not None and stage.phase.frame is not None:
        parts.append(f"frame {stage.phase.frame}")
    return "  ".join(parts)

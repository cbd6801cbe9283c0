"""Writes progress files at intervals, and where a stage ends before its schedule.

Lightning's ModelCheckpoint does less: it bounds no share of the time, ends the training on a full
disk, and may write what has diverged.
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.divergence_guard import DivergenceGuard
from devrf.checkpoints.progress import progress_file, progress_files
from devrf.engine.ddp import largest
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.system.process import Interrupted, handle_signals

log = logging.getLogger(__name__)

# Steps after which several processes tell one another of signals.
AGREE_EVERY = 10


class PeriodicCheckpoint(Callback):
    """Keeps a stage's last two progress files; stops the stage, saved, when it is asked to.

    A file that cannot be written (a full disk) does not end the training: the earlier ones stay,
    a line says so, and the next one is tried when it is due.

    Attributes:
        saved: the iteration of the last file written or resumed from; None before the first.
    """

    KEPT = 2

    def __init__(
        self, folder: str | Path = "checkpoints", every_seconds: float = 120.0, share: float = 0.05
    ) -> None:
        """Say where and how often.

        Args:
            folder: gets ``<stage>-progress-<iteration>.ckpt``.
            every_seconds: between files.
            share: the largest share of the time, 0 to 1, that writing may take.
        """
        if every_seconds < 0 or not 0 < share <= 1:
            raise DevrfError(
                "callbacks.checkpoint: expected every_seconds of 0 or more and a share above 0, at "
                f"most 1, not {every_seconds} and {share}"
            )
        self.folder = Path(folder)
        self.every_seconds = every_seconds
        self.share = share
        self.saved: int | None = None
        self._asked = False
        self._failing = False
        self._due = 0.0
        self._steps = 0

    def ask_to_stop(self) -> None:
        """End the training after the present Lightning step, with a progress file written."""
        self._asked = True

    def left_at(self, stage: Stage) -> str:
        """Where a stage has ended, and whether it can go on from there, in words."""
        done = stage.position.iteration
        total = stage.schedule.total
        where = f"iteration {done} of {total} of the {stage.name} stage"
        if done < total and done != (self.saved or 0):
            last = "there is none" if self.saved is None else f"the last is of {self.saved}"
            where += f" (its progress could not be written; {last})"
        return where

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        assert isinstance(pl_module, Stage)
        self._failing = False
        self.saved = pl_module.position.iteration or None
        self._due = time.monotonic() + self.every_seconds
        self._steps = 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write a file if one is due, or if the stage is to stop."""
        assert isinstance(pl_module, Stage)
        stopping = self._asked
        due = time.monotonic() >= self._due
        if trainer.world_size > 1:  # what one process is asked, all must do
            stopping, due = self._agreed(trainer.is_global_zero, pl_module.device)
        if pl_module.is_complete:
            return  # the stage is done: its checkpoint is next
        if stopping or due:
            self._write(trainer, pl_module)
        if stopping:
            self._asked = False
            trainer.should_stop = True
            trainer.limit_val_batches = 0  # Lightning would validate once more

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write a file where something else has ended the stage before its schedule."""
        assert isinstance(pl_module, Stage)
        if not pl_module.is_complete and self.saved != pl_module.position.iteration:
            self._write(trainer, pl_module)

    def _agreed(self, leads: bool, device: torch.device) -> tuple[bool, bool]:
        """Whether any process was asked to stop, and whether rank 0's next file is due.

        Processes wait for one another to tell that: in most steps nothing is asked or due.
        """
        self._steps += 1
        if self._steps % AGREE_EVERY != 1:
            return False, False
        stopping, due = largest([self._asked, leads and time.monotonic() >= self._due], device)
        return bool(stopping), bool(due)

    def _write(self, trainer: Trainer, stage: Stage) -> None:
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        for guard in callbacks:
            if isinstance(guard, DivergenceGuard):
                guard.check(stage)  # rolls back first: a diverged state is never written
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        if trainer.is_global_zero:
            self._write_file(trainer, stage)
        self.saved = trainer.strategy.broadcast(self.saved)

    def _write_file(self, trainer: Trainer, stage: Stage) -> None:
        began = time.monotonic()
        path = progress_file(self.folder, stage.name, stage.position.iteration)
        try:
            trainer.save_checkpoint(path)
        except OSError as error:
            if not self._failing:
                good = "there is none yet" if self.saved is None else f"iteration {self.saved}"
                log.warning(
                    "%s: %s; training goes on, the last good progress file stays (%s)",
                    path,
                    error.strerror,
                    good,
                )
            self._failing = True
        else:
            self.saved = stage.position.iteration
            self._failing = False
            files = progress_files(self.folder, stage.name)
            # Files further on are of a course that was rolled back.
            newest = files.index(path)
            for old in files[:newest] + files[newest + self.KEPT :]:
                old.unlink(missing_ok=True)
        now = time.monotonic()
        pause = (now - began) * (1 / self.share - 1)
        self._due = now + max(self.every_seconds, pause)


class StopOnSignal(Callback):
    """The first signal stops the stage, saved; a later Ctrl-C ends the run at once.

    Other later signals are ignored: launchers may repeat theirs. As a context manager it handles
    signals within its block; as a callback it takes them back from Lightning, whose handler would
    end the run with nothing written.

    Attributes:
        number: the first signal; None before it.
    """

    def __init__(self, saving: PeriodicCheckpoint) -> None:
        self.number: int | None = None
        self._saving = saving
        self._block = ExitStack()
        self._take: Callable[[], None] | None = None

    def __enter__(self) -> StopOnSignal:
        self._take = self._block.enter_context(handle_signals(self._answer))
        return self

    def __exit__(self, *_: object) -> None:
        self._block.close()

    def _answer(self, number: int) -> None:
        if self.number is None:
            self.number = number
            self._saving.ask_to_stop()
        elif number == signal.SIGINT:
            raise Interrupted(number, "ended at once; run the same command again to go on")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the signals back from Lightning."""
        if self._take is not None:
            self._take()

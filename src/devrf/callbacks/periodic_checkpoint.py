"""Writes progress files at intervals, and when the stage is asked to stop.

Lightning's ModelCheckpoint does less: it bounds no share of the time, ends the training on a full
disk, and may write what has diverged.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.divergence_guard import DivergenceGuard
from devrf.checkpoints.checkpoint import save_checkpoint
from devrf.checkpoints.progress import progress_file, progress_files
from devrf.engine.ddp import largest
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError

log = logging.getLogger(__name__)

# How often several processes tell one another of signals, and after how many steps at the latest.
AGREE_SECONDS, MOST_STEPS = 1.0, 200


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
                "callbacks.saving: expected every_seconds of 0 or more and a share above 0, at "
                f"most 1, not {every_seconds} and {share}"
            )
        self.folder = Path(folder)
        self.every_seconds = every_seconds
        self.share = share
        self.saved: int | None = None
        self._asked = False
        self._failing = False
        self._due = 0.0
        # Steps since processes last agreed, until they do next, and when that was.
        self._steps, self._next, self._last = 0, 1, 0.0

    def ask_to_stop(self) -> None:
        """End the training after the present Lightning step, with a progress file written."""
        self._asked = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock, and remove half-written files of a process that was killed."""
        assert isinstance(pl_module, ScheduledStage)
        self._failing = False
        self.saved = pl_module.iteration or None
        self._last = time.monotonic()
        self._due = self._last + self.every_seconds
        self._steps, self._next = 0, 1
        if trainer.is_global_zero:
            for path in self.folder.glob(f".partial-{pl_module.name}*.ckpt"):
                path.unlink(missing_ok=True)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write a file if one is due, if this step is the last, or if the stage is to stop."""
        assert isinstance(pl_module, ScheduledStage)
        asked, due = self._asked, time.monotonic() >= self._due
        if trainer.world_size > 1:  # what one process is asked, all must do
            asked, due = self._agreed(trainer.is_global_zero, pl_module.device)
        if pl_module.iteration >= pl_module.total_iterations:
            return  # the stage is done: its checkpoint is next
        # Lightning writes this step's row of the curves after this hook: a run that was killed in
        # between and resumed from a file written now would lack the row.
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        row_follows = every > 1 and (batch_idx + 1) % every == 0
        last = trainer.should_stop or 0 < trainer.max_steps <= trainer.global_step
        if asked or last or due and not row_follows:
            callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
            for one in callbacks:
                if isinstance(one, DivergenceGuard):
                    one.check(pl_module)  # rolls back first: a diverged state is never written
            if trainer.is_global_zero:
                self._write(trainer, pl_module)
        if asked:
            self._asked, trainer.should_stop = False, True

    def _agreed(self, leads: bool, device: torch.device) -> tuple[bool, bool]:
        """Whether any process was asked to stop, and whether rank 0's next file is due.

        Processes wait for one another to tell that, so they do it about every ``AGREE_SECONDS``, as
        rank 0 counts them, and in between nothing is asked or due.
        """
        self._steps += 1
        if self._steps < self._next:
            return False, False
        now = time.monotonic()
        pace = AGREE_SECONDS * self._steps / max(now - self._last, 1e-6)
        mine = [self._asked, leads and now >= self._due, int(min(pace, MOST_STEPS)) * leads]
        asked, due, steps = largest(mine, device)
        self._steps, self._next, self._last = 0, max(1, steps), now
        return bool(asked), bool(due)

    def _write(self, trainer: Trainer, stage: ScheduledStage) -> None:
        began, path = time.monotonic(), progress_file(self.folder, stage.name, stage.iteration)
        try:
            save_checkpoint(trainer, path, weights_only=False)
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
            self.saved, self._failing = stage.iteration, False
            files = progress_files(self.folder, stage.name)
            # Files further on are of a course that was rolled back.
            newest = files.index(path)
            for old in files[:newest] + files[newest + self.KEPT :]:
                old.unlink(missing_ok=True)
        now = time.monotonic()
        rest = (now - began) * (1 / self.share - 1)
        self._due = now + max(self.every_seconds, rest)

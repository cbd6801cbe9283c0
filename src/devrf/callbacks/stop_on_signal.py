"""Ends a stage after the present step when a signal arrives."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import ExitStack

from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.periodic_checkpoint import PeriodicCheckpoint
from devrf.system.process import Interrupted, handle_signals


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

"""What training took: time, iterations, memory."""

from __future__ import annotations

import time

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.previews import Previews
from devrf.stages.stage import ScheduledStage


class TrainingRecord(Callback):
    """Measures a stage's training and leaves the figures in its ``record``."""

    def __init__(self) -> None:
        self._started = 0.0
        self._before = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock and the memory's high-water mark."""
        assert isinstance(pl_module, ScheduledStage)
        if pl_module.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(pl_module.device)
        self._before = pl_module.iteration
        self._started = time.perf_counter()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write down seconds, iterations, iterations a second, peak GPU memory.

        Seconds are wall clock, without what previews took: they teach the fields nothing. Memory
        is in GiB; None on a CPU.
        """
        assert isinstance(pl_module, ScheduledStage)
        peak = None
        if pl_module.device.type == "cuda":
            torch.cuda.synchronize(pl_module.device)
            peak = round(torch.cuda.max_memory_allocated(pl_module.device) / 2**30, 3)
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        looking = sum(c.seconds for c in callbacks if isinstance(c, Previews))
        seconds = time.perf_counter() - self._started - looking
        pl_module.record = {
            "seconds": round(seconds, 2),
            "iterations": pl_module.iteration,
            "iterations_per_second": round((pl_module.iteration - self._before) / seconds, 2),
            "peak_gpu_gb": peak,
        }


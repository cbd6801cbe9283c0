"""What training took: time, iterations, memory."""

from __future__ import annotations

import time

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.stages.stage import ScheduledStage


class TrainingRecord(Callback):
    """Measures a stage's training and leaves the figures in its ``record``."""

    def __init__(self) -> None:
        self._started = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock and the memory's high-water mark."""
        if pl_module.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(pl_module.device)
        self._started = time.perf_counter()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write down wall-clock seconds, iterations and peak GPU memory (GiB; None on a CPU)."""
        assert isinstance(pl_module, ScheduledStage)
        peak = None
        if pl_module.device.type == "cuda":
            torch.cuda.synchronize(pl_module.device)
            peak = round(torch.cuda.max_memory_allocated(pl_module.device) / 2**30, 3)
        pl_module.record = {
            "seconds": round(time.perf_counter() - self._started, 2),
            "iterations": pl_module.iteration,
            "peak_gpu_gb": peak,
        }

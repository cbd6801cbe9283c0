"""Records the time, iterations and memory of training."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks.previews import Previews
from devrf.engine.stage import ScheduledStage
from devrf.system.speed import wait


class TrainingRecord(Callback):
    """Measures a stage's training into its ``record``, over all resumed runs."""

    def __init__(self) -> None:
        self._started = 0.0
        self._seconds_before = 0.0
        self._peak_before: float | None = None
        self._device: torch.device | None = None
        self._previews: list[Previews] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock and the memory's high-water mark."""
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        self._previews = [one for one in callbacks if isinstance(one, Previews)]
        self._device = pl_module.device
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self._device)
        self._started = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """Seconds and peak memory so far."""
        return {"seconds": self._seconds(), "peak_gpu_gb": self._peak()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Count on from what :meth:`state_dict` gave."""
        self._seconds_before = state_dict["seconds"]
        self._peak_before = state_dict["peak_gpu_gb"]

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Fill the record: wall-clock seconds without previews, memory in GiB (None on a CPU)."""
        assert isinstance(pl_module, ScheduledStage)
        wait(pl_module.device)
        seconds, done = self._seconds(), pl_module.iteration - pl_module.skipped
        pl_module.record = {
            "seconds": round(seconds, 2),
            "iterations": done,
            "iterations_per_second": round(done / seconds, 2),
            "peak_gpu_gb": self._peak(),
            "num_rollbacks": pl_module.num_rollbacks,
        }

    def _seconds(self) -> float:
        looking = sum(previews.seconds for previews in self._previews)
        return self._seconds_before + time.perf_counter() - self._started - looking

    def _peak(self) -> float | None:
        if self._device is None or self._device.type != "cuda":
            return self._peak_before
        peak = torch.cuda.max_memory_allocated(self._device) / 2**30
        return round(max(peak, self._peak_before or 0.0), 3)

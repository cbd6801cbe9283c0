"""Records the time, iterations and memory of training."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.engine.stage import Stage
from devrf.system.device import wait
from devrf.system.plain_data import validate


class TrainingRecord(Callback):
    """Measures a stage's training into its ``record``, over all resumed runs."""

    def __init__(self) -> None:
        self._stage: Stage | None = None
        self._seconds_before = 0.0
        self._peaks_before: tuple[float, float] | None = None
        self._device: torch.device | None = None
        # Of validations: the seconds that they took, and when the present one began.
        self._validating = 0.0
        self._began = 0.0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Note the stage, and forget the one before."""
        if stage != "fit":
            return
        assert isinstance(pl_module, Stage)
        self._stage = pl_module
        self._device = trainer.strategy.root_device
        self._validating = 0.0
        self._seconds_before = 0.0
        self._peaks_before = None

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop the clock."""
        wait(pl_module.device)
        self._began = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start it again."""
        wait(pl_module.device)
        self._validating += time.perf_counter() - self._began

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the memory's high-water mark; the clock runs since the stage's own setup."""
        if pl_module.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(pl_module.device)

    def state_dict(self) -> dict[str, Any]:
        """Seconds and peak memory so far."""
        return {"seconds": self.seconds, "peaks": self._peaks()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Count on from what :meth:`state_dict` gave."""
        peaks = state_dict["peaks"]
        self._seconds_before = float(state_dict["seconds"])
        self._peaks_before = None if peaks is None else validate(tuple[float, float], peaks)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Fill the record: wall-clock seconds without validation, memory in GiB (None on a CPU).

        ``peak_gpu_gb`` is what tensors took, ``peak_reserved_gb`` what torch's allocator held, with
        its caches.
        """
        assert isinstance(pl_module, Stage)
        wait(pl_module.device)
        seconds = self.seconds
        done = pl_module.position.iterations_done
        allocated, reserved = self._peaks() or (None, None)
        pl_module.provenance.record |= {
            "seconds": round(seconds, 2),
            "iterations": done,
            "iterations_per_second": round(done / seconds, 2),
            "peak_gpu_gb": allocated,
            "peak_reserved_gb": reserved,
            "num_rollbacks": pl_module.position.num_rollbacks,
        }

    @property
    def seconds(self) -> float:
        """Wall clock of the stage so far, in all runs, its setup included, validation not."""
        assert self._stage is not None
        since = time.perf_counter() - self._stage.began
        return self._seconds_before + since - self._validating

    def _peaks(self) -> tuple[float, float] | None:
        """GiB allocated and reserved at the peaks so far."""
        if self._device is None or self._device.type != "cuda":
            return self._peaks_before
        before = self._peaks_before or (0.0, 0.0)
        allocated = torch.cuda.max_memory_allocated(self._device) / 2**30
        reserved = torch.cuda.max_memory_reserved(self._device) / 2**30
        return round(max(allocated, before[0]), 3), round(max(reserved, before[1]), 3)

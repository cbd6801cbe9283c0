"""Curves beside those of the losses: PSNR, learning rates, speed, resolution, memory."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.apps.records import peak_host_memory
from devrf.callbacks.training_curve import batch_psnr
from devrf.engine.stage import ScheduledStage


class Meter(Callback):
    """Logs the batches' PSNR, learning rates, speed, resolution and memory beside the losses."""

    def __init__(self) -> None:
        self._last = (0.0, 0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        assert isinstance(pl_module, ScheduledStage)
        self._last = (time.perf_counter(), pl_module.iteration)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log in the steps in which Lightning logs; nothing is read from the device."""
        assert isinstance(pl_module, ScheduledStage)
        if not pl_module.logs(batch_idx):
            return
        now, done = time.perf_counter(), pl_module.iteration
        since, before = self._last
        self._last = (now, done)
        values: dict[str, float | None] = {
            "iterations_per_second": (done - before) / (now - since),
            "peak_host_gb": peak_host_memory(),
        }
        if pl_module.resolution:
            values["voxels"] = math.prod(pl_module.resolution)
        for group in pl_module.optimizer.param_groups:
            values[f"lr/{group['name']}"] = group["lr"]
        if pl_module.phase is not None and pl_module.phase.frames:
            values["frame"] = pl_module.phase.frames[0]  # a column has one number
        if pl_module.device.type == "cuda":
            values["peak_gpu_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 2**30
        psnr = batch_psnr(pl_module.logged if outputs else {})
        if psnr is not None:
            pl_module.log(f"{pl_module.capture}/psnr", psnr)
        # Tensors on the host: Lightning would copy numbers to the device, and wait.
        known = {name: torch.tensor(float(v)) for name, v in values.items() if v is not None}
        pl_module.log_dict({f"{pl_module.capture}/{name}": v for name, v in known.items()})

"""Figures of a stage beside its losses: rates, speed, sizes, memory."""

from __future__ import annotations

import math
import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.engine.stage import Stage
from devrf.system.memory import peak_host_memory


class Meter(Callback):
    """Adds rates, speed, frame, parameters, resolution and memory to each row that is logged."""

    def __init__(self) -> None:
        self._last = (0.0, 0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        assert isinstance(pl_module, Stage)
        self._last = (time.perf_counter(), pl_module.position.iterations_done)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log the figures where Lightning writes a row of this step."""
        assert isinstance(pl_module, Stage)
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not (trainer.should_stop or (every > 0 and (batch_idx + 1) % every == 0)):
            return
        now = time.perf_counter()
        done = pl_module.position.iterations_done
        since, before = self._last
        self._last = (now, done)
        groups = pl_module.optimizer.param_groups
        values: dict[str, float] = {
            "iterations_per_second": (done - before) / (now - since),
            "parameters": sum(value.numel() for group in groups for value in group["params"]),
        }
        if (peak := peak_host_memory()) is not None:
            values["peak_host_gb"] = peak
        if pl_module.scene_model.resolution:
            values["voxels"] = math.prod(pl_module.scene_model.resolution)
        for group in groups:
            values[f"lr/{group['name']}"] = group["lr"]
        if pl_module.phase is not None and pl_module.phase.frame is not None:
            values["frame"] = pl_module.phase.frame
        if pl_module.device.type == "cuda":
            values["peak_gpu_gb"] = torch.cuda.max_memory_allocated(pl_module.device) / 2**30
        figures = {f"{pl_module.capture}/{name}": float(value) for name, value in values.items()}
        pl_module.log_dict(figures, on_step=True, on_epoch=False, batch_size=1)

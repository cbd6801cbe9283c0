"""A stage is stopped by a signal, saved, and goes on."""

from __future__ import annotations

import math
import os
import signal
import tempfile
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from devrf.callbacks import PeriodicCheckpoint, StopOnSignal
from devrf.checkpoints.progress import progress_files
from devrf.engine.stage import ScheduledStage
from devrf.selfcheck.bench import Bench, Learned, Way, same_bits, tensors_of
from devrf.selfcheck.finding import Finding

# With CUDA graphs sums are added in changing order: the last loss may be off by this share.
CLOSE = 0.05


class SendSignal(Callback):
    """Sends this process SIGTERM, as a launcher would, in the middle of a stage."""

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Send it, half-way."""
        assert isinstance(pl_module, ScheduledStage)
        step = pl_module.iterations_per_step
        if 0 <= pl_module.iteration - pl_module.total_iterations // 2 < step:
            os.kill(os.getpid(), signal.SIGTERM)


def resume(bench: Bench, name: str, way: Way) -> Finding:
    """Whether a stage that SIGTERM stops goes on to what it would have come to.

    Equal bits where ``way`` is deterministic; else about the same loss.
    """
    below = bench.below(name)
    whole = bench.learn(bench.build(name, way, below), way)
    with tempfile.TemporaryDirectory() as folder:
        saving = PeriodicCheckpoint(folder, every_seconds=math.inf)
        first = bench.build(name, way, below)
        with StopOnSignal(saving) as stop:
            bench.learn(first, way, saving, stop, SendSignal())
        files = progress_files(Path(folder), name)
        total = first.total_iterations
        if stop.number is None or not 0 < first.iteration < total or not files:
            said = f"at iteration {first.iteration} of {total}, with {len(files)} progress files"
            return Finding(False, f"the signal did not stop the stage, saved: {said}")
        second = bench.build(name, way, below)
        rest = bench.learn(second, way, resumed_from=str(files[0]))
    return _compared(whole, rest, stopped_at=first.iteration, exact=way.deterministic)


def _compared(whole: Learned, rest: Learned, *, stopped_at: int, exact: bool) -> Finding:
    same = same_bits(tensors_of(whole.stage), tensors_of(rest.stage))
    steps = len(rest.losses)
    ours, theirs = (math.fsum(run.losses[-steps:]) / max(1, steps) for run in (rest, whole))
    off = abs(ours / theirs - 1) if theirs else math.inf
    finished = rest.stage.iteration == whole.stage.iteration
    said = f"stopped at iteration {stopped_at}, went on to {rest.stage.iteration}, "
    said += "equal bits" if same else f"the loss {100 * off:.2g} % off"
    held = finished and (same if exact else off <= CLOSE)
    figures = {"stopped_at": stopped_at, "same_bits": same, "loss_off": off}
    return Finding(held, said, figures)

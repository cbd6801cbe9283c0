"""Memory runs out on a GPU: in warm-up, in capture, and for good (docs/reliability.md#preflight).

torch's allocator is given a limit for the call that is to fail. Everything is real but the limit.
"""

from __future__ import annotations

import logging
import math
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks import PeriodicCheckpoint
from devrf.checkpoints.progress import progress_files
from devrf.engine.graphs import CudaGraphCapture, Work
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError
from devrf.selfcheck.bench import Bench, Way
from devrf.selfcheck.finding import Finding
from devrf.system.out_of_memory import free_cache

# Of the memory that a batch takes beside all else, the share that is left to it.
SHARE = 0.75
# Bytes for what an iteration draws before its batch is taken.
SMALL = 2**20
WAY = Way("triton", "auto")


@contextmanager
def at_most(device: torch.device, more: int) -> Iterator[None]:
    """Within the block torch's allocator may hold ``more`` bytes beside what it holds now."""
    free_cache(device)
    total = torch.cuda.get_device_properties(device).total_memory
    limit = torch.cuda.memory_reserved(device) + more
    torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total), device)
    try:
        yield
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, device)


class SecondWarmUp(CudaGraphCapture, ABC):
    """Captures, and does something about the second warm-up.

    The first one makes gradients and moments, which stay: the second takes a batch alone.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self._calls = 0

    def warm_up(self, work: Work) -> None:
        """Run ``work``, the second time within :meth:`around`."""
        self._calls += 1
        with self.around() if self._calls == 2 else nullcontext():
            super().warm_up(work)

    @abstractmethod
    def around(self) -> AbstractContextManager[None]:
        """What the second warm-up is run in."""


class MeasureBatch(SecondWarmUp):
    """Measures what the second warm-up takes beside all else.

    Attributes:
        taken: bytes at the peak, beyond what was held before.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.taken = 0

    @contextmanager
    def around(self) -> Iterator[None]:
        """Measure the block."""
        free_cache(self.device)
        before = torch.cuda.memory_reserved(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        yield
        self.taken = max(1, torch.cuda.max_memory_reserved(self.device) - before)


class ScarceWarmUp(SecondWarmUp):
    """The second warm-up may take ``more`` bytes, also when it is done in parts."""

    def __init__(self, device: torch.device, more: int) -> None:
        super().__init__(device)
        self._more = more

    def around(self) -> AbstractContextManager[None]:
        """Little memory for the block."""
        return at_most(self.device, self._more)


class ScarceCapture(CudaGraphCapture):
    """The first capture may not take any memory."""

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.failed = False

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        """A graph of ``work``; the first time memory is short."""
        if self.failed:
            return super().capture(work)
        self.failed = True
        with at_most(self.device, 0):
            return super().capture(work)


class Warnings(logging.Handler):
    """Keeps the warnings of devrf's log.

    Attributes:
        lines: the messages.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message."""
        self.lines.append(record.getMessage())

    @contextmanager
    def listening(self) -> Iterator[list[str]]:
        """The messages of the block."""
        logger = logging.getLogger("devrf")
        logger.addHandler(self)
        try:
            yield self.lines
        finally:
            logger.removeHandler(self)


def in_warm_up(bench: Bench) -> Finding:
    """Whether batches are taken in parts, and all is learned, when a warm-up has too little."""
    measuring = MeasureBatch(bench.device)
    _learn(bench, measuring)
    stage, losses, said = _learn(bench, ScarceWarmUp(bench.device, int(SHARE * measuring.taken)))
    parts = stage.loop.micro_batching.count
    held = parts > 1 and _finished(stage, losses) and any("parts" in line for line in said)
    words = f"batches were taken in {parts} parts, {stage.iteration} iterations"
    figures = {"batch_bytes": measuring.taken, "parts": parts, "said": said}
    return Finding(held, words, figures)


def in_capture(bench: Bench) -> Finding:
    """Whether iterations go on one by one, and all is learned, when a capture has too little."""
    capturer = ScarceCapture(bench.device)
    stage, losses, said = _learn(bench, capturer)
    told = any(line.startswith("graphs:") for line in said)
    held = capturer.failed and told and stage.loop.graphs == "off" and _finished(stage, losses)
    words = "went on without graphs" if stage.loop.graphs == "off" else "was captured all the same"
    return Finding(held, f"{words}, {stage.iteration} iterations", {"said": said})


class NoMemory(Callback):
    """In one Lightning step there is no more memory than a stage holds, but for small tensors."""

    def __init__(self, device: torch.device, step: int) -> None:
        self._device, self._step = device, step
        self._limit = at_most(device, SMALL)
        self._filled: list[torch.Tensor] = []

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Free what an iteration needs, forbid to take it again, and fill the gaps."""
        if batch_idx != self._step:
            return
        assert isinstance(pl_module, ScheduledStage)
        pl_module.loop.recapture()
        self._limit.__enter__()
        # Gaps belong to the stream that they were made on.
        streams = [torch.cuda.current_stream(self._device)]
        if pl_module.loop._capture is not None:
            streams.append(pl_module.loop._capture._side)
        for stream in streams:
            with torch.cuda.stream(stream):
                self._fill()

    def _fill(self) -> None:
        for size in (2**26, 2**23, 2**21):
            with suppress(torch.OutOfMemoryError):
                while True:
                    made = torch.empty(size, dtype=torch.uint8, device=self._device)
                    self._filled.append(made)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Lift the limit: a progress file is written next."""
        if batch_idx == self._step:
            self._filled = []
            self._limit.__exit__(None, None, None)


def for_good(bench: Bench) -> Finding:
    """Whether a stage for which no part is small enough ends saved, in one line."""
    stage, step = bench.canonical(WAY), 3
    with tempfile.TemporaryDirectory() as folder:
        saving = PeriodicCheckpoint(folder, every_seconds=math.inf)
        try:
            bench.learn(stage, WAY, NoMemory(bench.device, step), saving)
            return Finding(False, "the stage was learned all the same")
        except DevrfError as error:
            message = str(error)
        files = len(progress_files(Path(folder), stage.name))
    held = "out of memory" in message and "\n" not in message and files > 0
    return Finding(held, f"ended with {files} progress file(s): {message}")


def _learn(
    bench: Bench, capturer: CudaGraphCapture
) -> tuple[ScheduledStage, list[float], list[str]]:
    """The canonical stage, its losses, and what was said."""
    stage = bench.canonical(WAY)
    stage.loop._capture = capturer
    with Warnings().listening() as said:
        learned = bench.learn(stage, WAY)
    return stage, learned.losses, said


def _finished(stage: ScheduledStage, losses: list[float]) -> bool:
    whole = stage.iteration == stage.total_iterations
    return whole and all(map(math.isfinite, losses)) and min(losses) < losses[0]

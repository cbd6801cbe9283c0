"""Stretches of a stage's schedule instead of all of it, each of them timed."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from devrf.cli.roofline import roofline
from devrf.cli.timing import Spread, Timing
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import SceneModel
from devrf.methods.devrf.schedules import CanonicalPhase, DeformationPhase
from devrf.system.profiling import OVERHEAD, Stopwatch, measuring
from devrf.system.speed import wait


class PhaseBenchmark(Callback):
    """Takes a stage through some of its phases, whatever iteration it is at, and times its steps.

    It stands in for ``GridUpscaling``; the stage trains as ever, in Lightning steps of its own.
    Steps that nobody disturbs take turns with steps whose parts are measured
    (:func:`devrf.system.profiling.measuring`).

    Attributes:
        timings: one for each phase, in the order in which they were visited.
    """

    def __init__(
        self, iterations: Sequence[int], warmup: int, repeats: int, learned: SceneModel | None
    ) -> None:
        """Say what to visit.

        Args:
            iterations: one of each phase that is visited, in this order.
            warmup: Lightning steps in each phase before any counts.
            repeats: steps of either kind.
            learned: fields to start from, as though training had just ended; each phase is
                entered with them at its own resolution. They are copied. None: as the stage is.
        """
        self.timings: list[Timing] = []
        self._ahead = list(iterations)
        self._warmup, self._repeats = warmup, repeats
        self._learned = learned
        self._steps = 0
        self._start = (0.0, 0)
        self._open = ExitStack()
        self._undisturbed: list[float] = []
        self._watches: list[tuple[Stopwatch, int]] = []

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give the stage the learned fields."""
        assert isinstance(pl_module, ScheduledStage)
        if self._learned is None:
            return
        learned, model = copy.deepcopy(self._learned).to(pl_module.device), pl_module.model
        model.canonical, model.occupancy = learned.canonical, learned.occupancy
        last = pl_module.phase_at(pl_module.total_iterations)
        if isinstance(last, DeformationPhase):
            assert learned.deformation is not None
            model.canonical.requires_grad_(False)
            model.deformation = learned.deformation
            if model.deformation.shape != model.canonical.box.grid_shape(last.side**3):
                model.deformation.resize(last.side**3)
        pl_module.phase = last

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Go to the next phase, or on within the present one, and start the clock."""
        assert isinstance(pl_module, ScheduledStage)
        if self._steps == 0:
            entered = pl_module.phase_at(self._ahead.pop(0))
            pl_module.iteration = entered.start
            pl_module.enter(entered)
        phase, count = pl_module.phase, pl_module.iterations_per_step
        assert phase is not None
        if pl_module.iteration + count > phase.stop:
            pl_module.iteration = phase.start
        if self._steps == self._warmup and pl_module.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(pl_module.device)
        wait(pl_module.device)
        self._start = (time.perf_counter(), pl_module.iteration)
        if self._is_measured:
            watch = self._open.enter_context(measuring(pl_module.device))
            self._watches.append((watch, 0))

    @property
    def _is_measured(self) -> bool:
        """Whether the present step's parts are measured."""
        return self._steps >= self._warmup and (self._steps - self._warmup) % 2 == 1

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop the clock; after enough steps of a phase write down what it takes."""
        assert isinstance(pl_module, ScheduledStage)
        self._open.close()
        wait(pl_module.device)
        start, before = self._start
        count = pl_module.iteration - before
        if self._is_measured:
            self._watches[-1] = (self._watches[-1][0], count)
        elif self._steps >= self._warmup:
            self._undisturbed.append((time.perf_counter() - start) / count)
        self._steps += 1
        if self._steps < self._warmup + 2 * self._repeats:
            # A stage that has come to its end would stop: it is sent back.
            trainer.should_stop = False
            return
        self.timings.append(self._timing(pl_module, count))
        self._steps, self._undisturbed, self._watches = 0, [], []
        trainer.should_stop = not self._ahead

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Measure no longer."""
        self._open.close()

    def _timing(self, stage: ScheduledStage, iterations: int) -> Timing:
        """What the present phase takes."""
        assert isinstance(stage, CanonicalStage | DeformationStage) and stage.phase is not None
        phase, device = stage.phase, stage.device
        spent = [
            {part: seconds / count for part, seconds in watch.seconds().items()}
            for watch, count in self._watches
        ]
        names = dict.fromkeys(name for parts in spent for name in parts if name != OVERHEAD)
        done = sum(count for _, count in self._watches)
        seen: dict[str, float] = {}
        for watch, _ in self._watches:
            for name, number in watch.counts.items():
                seen[name] = seen.get(name, 0.0) + float(number) / done
        cuda = device.type == "cuda"
        return Timing(
            stage="canonical" if isinstance(phase, CanonicalPhase) else "deformation",
            phase=phase.kind if isinstance(phase, CanonicalPhase) else f"level {phase.level}",
            resolution=stage.resolution,
            frames=phase.frames if isinstance(phase, DeformationPhase) else (),
            rays=stage.schedule.rays * len(stage.loop.lanes),
            iterations=iterations,
            seconds=Spread.of(self._undisturbed),
            measured_seconds=Spread.of([sum(parts.values()) for parts in spent]),
            parts={
                name: Spread.of([parts.get(name, 0.0) for parts in spent])
                for name in (*names, OVERHEAD)
            },
            counts=seen,
            work=roofline(stage, seen),
            allocated=torch.cuda.max_memory_allocated(device) if cuda else None,
            reserved=torch.cuda.max_memory_reserved(device) if cuda else None,
        )

"""Notes what a run does while it does it: seconds by what they go to."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import torch

from devrf.callbacks import Meter
from devrf.engine.stage import Stage
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.system.device import wait

Row = dict[str, Any]
# Methods that are timed, with what is nested in them, by what their seconds go to.
TIMED = {
    "iterations": (Stage, "training_step"),
    "logging": (Meter, "on_train_batch_end"),
    "visits, canonical": (CanonicalStage, "enter"),
    "visits, deformation": (DeformationStage, "enter"),
    "packing": (Stage, "on_train_end"),
}


class Stopwatch:
    """Within its context, times what stages do.

    Attributes:
        stage: the stage that was learned last.
    """

    def __init__(self, device: torch.device) -> None:
        self.stage: Stage | None = None
        self._device, self._usual = device, dict[tuple[type, str], Any]()
        self._seconds: dict[str, float] = defaultdict(float)
        # By resolution: seconds and iterations.
        self._levels: dict[tuple[int, ...], tuple[float, int]] = {}
        self._since, self._iteration = time.perf_counter(), 0

    def __enter__(self) -> Stopwatch:
        for label, (owner, name) in TIMED.items():
            self._replace(owner, name, self._timed(label, getattr(owner, name)))
        self._since = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        if self.stage is not None:
            self._mark()
        for (owner, name), usual in self._usual.items():
            setattr(owner, name, usual)

    def rows(self) -> Iterator[Row]:
        """Seconds by what they went to; then milliseconds of an iteration by resolution."""
        yield {"seconds": dict(self._seconds)}
        for shape, (seconds, iterations) in self._levels.items():
            yield {
                "grid": shape,
                "iterations": iterations,
                "ms": 1000 * seconds / max(iterations, 1),
            }

    def _replace(self, owner: type, name: str, function: Any) -> None:
        self._usual[owner, name] = getattr(owner, name)
        setattr(owner, name, function)

    def _timed(self, label: str, usual: Any) -> Any:
        def method(own: Any, *args: Any, **options: Any) -> Any:
            if label.startswith("visits") and own is self.stage:
                self._mark()
            began = time.perf_counter()
            try:
                return usual(own, *args, **options)
            finally:
                self._seconds[label] += time.perf_counter() - began
                if label.startswith("visits"):
                    self.stage, self._since = own, time.perf_counter()

        return method

    def _mark(self) -> None:
        """Add what has passed since the last visit began to the resolution's time."""
        stage = self.stage
        assert stage is not None
        wait(self._device)
        shape = tuple(stage.scene_model.resolution)
        seconds, iterations = self._levels.get(shape, (0.0, 0))
        seconds += time.perf_counter() - self._since
        self._levels[shape] = seconds, iterations + stage.position.iteration - self._iteration
        self._since, self._iteration = time.perf_counter(), stage.position.iteration

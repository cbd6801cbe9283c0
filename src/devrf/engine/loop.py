"""How an iteration is carried out, whichever stage learns in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.engine.ddp import average, average_gradients, rays_per_rank, world_size
from devrf.engine.learner import Learner
from devrf.engine.micro_batching import MicroBatching
from devrf.system.memory import OutOfMemoryError
from devrf.system.profiling import span


class MetricAccumulator:
    """Sums by name, in the same memory from the first :meth:`add` on."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._values: Tensor | None = None  # (names,)

    def add(self, terms: Mapping[str, Tensor]) -> None:
        """Add the values () of an iteration by name; the names are always the same."""
        self._names = tuple(terms)
        values = torch.stack(list(terms.values()))
        self._values = values if self._values is None else self._values.add_(values)

    def take(self, iterations: int, processes: int) -> dict[str, Tensor]:
        """The means () over ``iterations`` and all ``processes``; the sums are set to zero."""
        assert self._values is not None
        means = (average(self._values) if processes > 1 else self._values) / iterations
        self._values.zero_()
        return dict(zip(self._names, means.unbind(), strict=True))


class Loop:
    """Runs iterations: one optimiser step each, on one batch.

    Attributes:
        micro_batching: divides batches when memory runs out.
        metrics: losses and their terms since they were last taken.
        batch_share: the part of a batch that is drawn; a time budget may halve it.
        processes: how many learn together.
    """

    def __init__(self) -> None:
        self.micro_batching = MicroBatching()
        self.metrics = MetricAccumulator()
        self.batch_share = 1.0
        self.processes = 1
        self._rays = 0

    @property
    def rays(self) -> int:
        """Rays of a batch in this process."""
        return max(1, round(self._rays * self.batch_share))

    def bind(self, rays: int) -> None:
        """Prepare for iterations with ``rays`` in a batch, over all processes."""
        self.metrics = MetricAccumulator()
        self._rays, self.processes = rays_per_rank(rays), world_size()

    def step(self, stage: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """Run one iteration.

        Args:
            stage: draws pixels and computes their loss.
            views: the images of all pixels.
            optimizer: the stage's, wrapped by Lightning, which calls callbacks before it steps.

        Raises:
            OutOfMemoryError: the smallest micro-batch does not fit; no parameter has changed.
        """
        pixels = stage.draw()
        stage.optimizer.make_gradients()  # Lightning drops them where a run is resumed

        def backward(total: Tensor) -> None:
            with span("backward"):
                stage.manual_backward(total)

        try:
            total, terms = self.micro_batching.gradients(
                lambda part: stage.loss(views, part),
                pixels,
                backward,
                stage.optimizer.zero_grad,
            )
            if self.processes > 1:
                groups = stage.optimizer.param_groups
                average_gradients(p for group in groups for p in group["params"])
            self.metrics.add({"loss": total.detach(), **terms})
            with span("optimiser"):
                optimizer.step()
        except OutOfMemoryError:
            optimizer.zero_grad()  # of the micro-batches that did fit
            raise

"""How an iteration is carried out, whichever stage learns in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.engine.ddp import average, average_gradients, rays_per_rank, world_size
from devrf.engine.learner import Learner, ParallelBatch
from devrf.engine.micro_batching import MicroBatching
from devrf.system.memory import OutOfMemoryError
from devrf.system.profiling import span


class MetricAccumulator:
    """Sums by name for each parallel batch, in the same memory from the first :meth:`add` on."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._values: Tensor | None = None  # (batches, names)

    def add(self, batches: Sequence[Mapping[str, Tensor]]) -> None:
        """Add the values () of an iteration, by name for each batch; all have the same names."""
        self._names = tuple(batches[0])
        values = [terms[name] for terms in batches for name in self._names]
        if self._values is None:
            self._values = torch.stack(values).view(len(batches), len(self._names))
        else:
            torch._foreach_add_(self._values.view(-1).unbind(), values)

    def take(self, iterations: int, processes: int) -> tuple[dict[str, Tensor], Tensor]:
        """The means over ``iterations`` and all ``processes``; the sums are set to zero.

        Returns:
            For each name the mean over the batches, (); for each batch its ``loss``, (batches,).
        """
        assert self._values is not None
        means = (average(self._values) if processes > 1 else self._values) / iterations
        self._values.zero_()
        over_batches = dict(zip(self._names, means.mean(dim=0).unbind(), strict=True))
        return over_batches, means[:, self._names.index("loss")]


class Loop:
    """Runs iterations: one optimiser step each, on one batch or on several independent ones.

    Attributes:
        batches: the batches of an iteration; empty before :meth:`bind`.
        micro_batching: divides batches when memory runs out.
        metrics: losses and their terms since they were last taken.
        batch_share: the part of a batch that is drawn; a time budget may halve it.
    """

    def __init__(self) -> None:
        self.batches: list[ParallelBatch] = []
        self.micro_batching = MicroBatching()
        self.metrics = MetricAccumulator()
        self.batch_share = 1.0
        self._rays, self.processes = 0, 1

    @property
    def rays(self) -> int:
        """Rays of a batch in this process."""
        return max(1, round(self._rays * self.batch_share))

    def bind(self, rays: int, parameters: Sequence[Sequence[Tensor]]) -> None:
        """Prepare for iterations on other tensors than before.

        Args:
            rays: rays of a batch, over all processes.
            parameters: for each batch of an iteration, what is learned from it.
        """
        self.release()
        self._rays, self.processes = rays_per_rank(rays), world_size()
        self.batches = [ParallelBatch(k, learned) for k, learned in enumerate(parameters)]

    def release(self) -> None:
        """Drop batches and metrics."""
        self.batches, self.metrics = [], MetricAccumulator()

    def step(self, stage: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """Run one iteration.

        Args:
            stage: draws pixels and computes their loss.
            views: the images of all pixels.
            optimizer: the stage's, wrapped by Lightning, which calls callbacks before it steps.

        Raises:
            OutOfMemoryError: the smallest micro-batch does not fit; no parameter has changed.
        """
        for batch in self.batches:
            batch.pixels = stage.draw(batch)
        stage.optimizer.make_gradients()  # Lightning drops them where a run is resumed
        try:
            self._accumulate(stage, views)
            with span("optimiser"):
                optimizer.step()
        except OutOfMemoryError:
            optimizer.zero_grad()  # of the batches that did fit
            raise

    def _accumulate(self, stage: Learner, views: Any) -> None:
        """Compute the gradients of all batches; add losses and terms to the metrics."""
        terms = [self._gradients(batch, stage, views) for batch in self.batches]
        if self.processes > 1:
            groups = stage.optimizer.param_groups
            average_gradients(p for group in groups for p in group["params"])
        self.metrics.add(terms)

    def _gradients(self, batch: ParallelBatch, stage: Learner, views: Any) -> dict[str, Tensor]:
        """Compute the gradients of one batch; its loss and terms by name."""
        assert batch.pixels is not None

        def backward(total: Tensor) -> None:
            with span("backward"):
                stage.manual_backward(total)

        total, terms = self.micro_batching.gradients(
            lambda pixels: stage.loss(batch, views, pixels),
            batch.pixels,
            backward,
            lambda: stage.optimizer.drop_gradients(batch.parameters),
        )
        return {"loss": total.detach(), **terms}

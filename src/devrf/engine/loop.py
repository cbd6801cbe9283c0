"""How an iteration is carried out, whatever is learned in it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import average_gradients, rays_per_rank, world_size
from devrf.engine.graphs import Capturer, CudaGraphCapture, GraphedStep, Graphs
from devrf.engine.metric_accumulator import MetricAccumulator
from devrf.engine.micro_batching import MicroBatching
from devrf.engine.parallel_batch import ParallelBatch
from devrf.engine.streams import StreamParallel
from devrf.ops.adam import GridAdam
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.system.out_of_memory import OutOfMemoryError
from devrf.system.profiling import measured, span
from devrf.system.speed import wait


class Learner(Protocol):
    """What is learned: a stage."""

    @property
    def optimizer(self) -> GridAdam:
        """What steps on the parameters of all batches."""
        ...

    def draw(self, batch: ParallelBatch) -> Pixels:
        """The pixels of a batch's coming iteration."""
        ...

    def loss(
        self, batch: ParallelBatch, views: Any, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss of a batch's pixels of ``views``, and its terms by name."""
        ...

    def manual_backward(self, loss: Tensor) -> Any:
        """Add the gradients of a loss to those that are there."""
        ...


class Loop:
    """Iterations, one after another: each one optimiser step on one batch, or on several.

    Several independent batches are learned from in parallel. Where memory is short a batch is
    divided into micro-batches. Where shapes are static, the lists of samples have a fixed length
    (their ``capacity``); gradients, moments and whatever else goes from one iteration to the next
    stay in the same memory, and nothing waits for the device. On one GPU each iteration is then a
    CUDA graph that is replayed.

    Attributes:
        graphs: whether static-shape iterations are captured in a CUDA graph where possible.
        batches: the batches of an iteration; none before :meth:`bind`.
        micro_batching: how batches are divided when memory runs out.
        metrics: losses and their terms, over the iterations since they were last taken.
    """

    def __init__(self, graphs: Graphs = "auto") -> None:
        self.graphs = graphs
        self.batches: list[ParallelBatch] = []
        self.micro_batching = MicroBatching()
        self.metrics = MetricAccumulator()
        self._rays = 0
        self._device = torch.device("cpu")
        self._streams = StreamParallel()
        self._graphed: GraphedStep | None = None

    @property
    def capacities(self) -> list[SampleCapacity]:
        """How long each batch's lists of samples are; none unless shapes are static."""
        return [batch.capacity for batch in self.batches if batch.capacity is not None]

    def bind(
        self,
        rays: int,
        parameters: Sequence[Sequence[Tensor]],
        optimizer: GridAdam,
        *,
        static_shape: bool,
    ) -> None:
        """Get ready for iterations on other tensors than before.

        Args:
            rays: of a batch, in all processes together.
            parameters: what is learned from each of the batches of an iteration.
            optimizer: what steps on them; it has them.
            static_shape: whether no shape of an iteration may depend on data.
        """
        self.release()
        self._rays, self._device = rays, parameters[0][0].device
        self.batches = [ParallelBatch(k, learned) for k, learned in enumerate(parameters)]
        if static_shape:
            self._make_capacities()
            optimizer.keep_gradients()

    def release(self) -> None:
        """Drop what only iterations need: a captured one holds memory of its own."""
        self.batches, self.metrics, self._graphed = [], MetricAccumulator(), None

    def step(self, learner: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """One iteration.

        Args:
            learner: what is learned.
            views: the images of all pixels.
            optimizer: the learner's, as Lightning hands it out: callbacks are asked before it
                steps, or before the whole iteration if its shapes are static.

        Raises:
            OutOfMemoryError: there is no room for the smallest micro-batch; nothing was learned.
        """
        for batch in self.batches:
            batch.take(learner.draw(batch))
        try:
            if self.capacities:
                self._static_step(learner, views, optimizer)
            else:
                optimizer.zero_grad()
                self._accumulate(learner, views)
                with span("optimiser"):
                    optimizer.step()
        except OutOfMemoryError:
            optimizer.zero_grad()  # of batches that had room
            raise

    def poll(self) -> None:
        """Fit the lists to what iterations needed, as far as that is known by now."""
        if any([capacity.poll() for capacity in self.capacities]):  # a list: all of them are asked
            self._graphed = None  # captured with lists of another length

    def _make_capacities(self) -> None:
        rays = -(-rays_per_rank(self._rays) // self.micro_batching.count)
        for batch in self.batches:
            batch.capacity = SampleCapacity(rays, self._device)

    def _accumulate(self, learner: Learner, views: Any) -> None:
        """The gradients of each batch; losses and terms are added to the metrics."""
        pieces = [partial(self._gradients, batch, learner, views) for batch in self.batches]
        found = self._streams(pieces, self._device)
        groups = learner.optimizer.param_groups
        average_gradients(p for group in groups for p in group["params"])
        self.metrics.add(found)

    def _gradients(self, batch: ParallelBatch, learner: Learner, views: Any) -> dict[str, Tensor]:
        """The gradients of one batch, its loss and its terms."""
        assert batch.pixels is not None

        def backward(total: Tensor) -> None:
            with span("backward"):
                learner.manual_backward(total)

        total, terms = self.micro_batching.gradients(
            lambda pixels: learner.loss(batch, views, pixels),
            batch.pixels,
            backward,
            lambda: self._divided(batch, learner.optimizer),
        )
        return {"loss": total.detach(), **terms}

    def _divided(self, batch: ParallelBatch, optimizer: GridAdam) -> None:
        """Begin a batch's iteration anew in smaller parts, which are those of all batches."""
        wait(self._device)  # other batches may be at work in their lists
        optimizer.drop_gradients(batch.parameters)
        if self.capacities:
            self._make_capacities()
            self._graphed = None

    def _static_step(self, learner: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """An iteration of static shape: the same work on the same tensors, with other pixels."""

        def work() -> None:
            self._accumulate(learner, views)
            with span("optimiser"):
                learner.optimizer.apply()

        if self._graphed is None:
            self._graphed = GraphedStep(work, self._capturer())
        graphed = self._graphed  # which is gone if memory runs out on the way
        # A replayed graph shows none of its parts to a profiler.
        with learner.optimizer.stepping_by(work if measured() else graphed):
            optimizer.step()
        if graphed.is_warm:
            for capacity in self.capacities:
                capacity.measure()
        if graphed.failed:
            self.graphs = "off"  # one warning is enough

    def _capturer(self) -> Capturer | None:
        """How iterations are captured: on one GPU, if at all."""
        possible = self.graphs == "auto" and self._device.type == "cuda" and world_size() == 1
        return CudaGraphCapture(self._device) if possible else None

"""How an iteration is carried out, whichever stage learns in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import average, average_gradients, rays_per_rank, world_size
from devrf.engine.learner import Learner, ParallelBatch
from devrf.engine.micro_batching import MicroBatching
from devrf.ops.adam import GridAdam
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.system.device import wait
from devrf.system.graphs import CudaGraphCapture, GraphedStep, Graphs
from devrf.system.memory import OutOfMemoryError
from devrf.system.profiling import measured, span
from devrf.system.streams import StreamParallel


def take(batch: ParallelBatch, drawn: Pixels) -> None:
    """Set a batch's pixels to ``drawn``; with a capacity, copy them into the same memory."""
    if batch.capacity is None:
        batch.pixels = drawn
    elif batch.pixels is None:
        batch.pixels = drawn.clone()
    else:
        batch.pixels.take(drawn)


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

    Several batches are processed in parallel. With static shapes the lists of samples have a fixed
    length (their ``capacity``), everything that outlives an iteration stays in the same memory, and
    nothing waits for the device; on one GPU iterations are then replayed from a CUDA graph.

    Attributes:
        graphs: ``off``: never capture iterations in a CUDA graph.
        batches: the batches of an iteration; empty before :meth:`bind`.
        micro_batching: divides batches when memory runs out.
        metrics: losses and their terms since they were last taken.
        num_captures: how many CUDA graphs have been captured.
        num_short_lists: how often a list of samples was found to have been too short, so that
            samples of the last rays were dropped.
        batch_share: the part of a batch that is drawn; a time budget may halve it.
    """

    def __init__(self, graphs: Graphs = "auto") -> None:
        self.graphs = graphs
        self.batches: list[ParallelBatch] = []
        self.micro_batching = MicroBatching()
        self.metrics = MetricAccumulator()
        self.num_captures = self.num_short_lists = 0
        self.batch_share = 1.0
        self._rays, self.processes = 0, 1
        self._device = torch.device("cpu")
        # What losses are scaled by in the backward pass, which would fill one each time.
        self._one = torch.ones(())
        self._streams = StreamParallel()
        self._graphed: GraphedStep | None = None
        self._capture: CudaGraphCapture | None = None

    @property
    def rays(self) -> int:
        """Rays of a batch in this process."""
        return max(1, round(self._rays * self.batch_share))

    @property
    def capacities(self) -> list[SampleCapacity]:
        """The lengths of each batch's sample lists; empty unless shapes are static."""
        return [batch.capacity for batch in self.batches if batch.capacity is not None]

    def bind(
        self,
        rays: int,
        parameters: Sequence[Sequence[Tensor]],
        optimizer: GridAdam,
        *,
        static_shape: bool,
    ) -> None:
        """Prepare for iterations on other tensors than before.

        Args:
            rays: rays of a batch, over all processes.
            parameters: for each batch of an iteration, what is learned from it.
            optimizer: holds these parameters already.
            static_shape: whether all shapes must be independent of data.
        """
        self.release()
        self._rays, self.processes = rays_per_rank(rays), world_size()
        self._device = parameters[0][0].device
        self._one = self._one.to(self._device)
        self.batches = [ParallelBatch(k, learned) for k, learned in enumerate(parameters)]
        if static_shape:
            self._make_capacities()
            optimizer.keep_gradients()

    def release(self) -> None:
        """Drop batches, metrics and the captured graph with its memory."""
        self.batches, self.metrics, self._graphed = [], MetricAccumulator(), None

    def recapture(self) -> None:
        """Capture the next iteration anew: a setting that the graph contains has changed."""
        self._graphed = None

    def step(self, stage: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """Run one iteration.

        Args:
            stage: draws pixels and computes their loss.
            views: the images of all pixels.
            optimizer: the stage's, wrapped by Lightning, which calls callbacks before it steps
                (with static shapes: before the whole iteration).

        Raises:
            OutOfMemoryError: the smallest micro-batch does not fit; no parameter has changed.
        """
        for batch in self.batches:
            take(batch, stage.draw(batch))
        stage.optimizer.make_gradients()  # Lightning drops them where a run is resumed
        try:
            if self.capacities:
                self._static_step(stage, views, optimizer)
            else:
                self._accumulate(stage, views)
                with span("optimiser"):
                    optimizer.step()
        except OutOfMemoryError:
            optimizer.zero_grad()  # of the batches that did fit
            raise

    def poll(self) -> None:
        """Adapt the capacities to the sample counts that have reached the host."""
        before = sum(capacity.num_short for capacity in self.capacities)
        if any([capacity.poll() for capacity in self.capacities]):  # a list: poll all of them
            self.recapture()  # it has the former lengths
        self.num_short_lists += sum(capacity.num_short for capacity in self.capacities) - before

    def _make_capacities(self) -> None:
        rays = -(-self.rays // self.micro_batching.count)
        for batch in self.batches:
            batch.capacity = SampleCapacity(rays, self._device)

    def _accumulate(self, stage: Learner, views: Any) -> None:
        """Compute the gradients of all batches; add losses and terms to the metrics."""
        pieces = [partial(self._gradients, batch, stage, views) for batch in self.batches]
        terms = self._streams(pieces, self._device)
        if self.processes > 1:
            groups = stage.optimizer.param_groups
            average_gradients(p for group in groups for p in group["params"])
        self.metrics.add(terms)

    def _gradients(self, batch: ParallelBatch, stage: Learner, views: Any) -> dict[str, Tensor]:
        """Compute the gradients of one batch; its loss and terms by name."""
        assert batch.pixels is not None

        def backward(total: Tensor) -> None:
            with span("backward"):
                stage.manual_backward(total, gradient=self._one)

        total, terms = self.micro_batching.gradients(
            lambda pixels: stage.loss(batch, views, pixels),
            batch.pixels,
            backward,
            lambda: self._divided(batch, stage.optimizer),
        )
        return {"loss": total.detach(), **terms}

    def _divided(self, batch: ParallelBatch, optimizer: GridAdam) -> None:
        """Prepare to restart a batch's iteration; later batches use the smaller parts, too."""
        wait(self._device)  # other streams may still write to their lists
        optimizer.drop_gradients(batch.parameters)
        if self.capacities:
            self._make_capacities()
            self._graphed = None

    def _static_step(self, stage: Learner, views: Any, optimizer: LightningOptimizer) -> None:
        """An iteration with static shapes: the same work on the same tensors, with other pixels."""

        def work() -> None:
            self._accumulate(stage, views)
            with span("optimiser"):
                stage.optimizer.apply()

        if self._graphed is None:
            # Over every training view, so that the lists that are captured are long enough for all.
            warm_up = max(GraphedStep.WARM_UP, stage.view_cycle)
            self._graphed = GraphedStep(work, self.capturer(), warm_up)
        graphed = self._graphed  # the attribute is reset if memory runs out in the step
        # A profiler cannot attribute a replayed graph to parts.
        with stage.optimizer.stepping_by(work if measured() else graphed):
            optimizer.step()
        if graphed.has_captured:
            self.num_captures += 1
        if graphed.is_warm:
            for capacity in self.capacities:
                capacity.measure()
        if graphed.failed:
            self.graphs = "off"  # one warning is enough

    def capturer(self) -> CudaGraphCapture | None:
        """Captures work in graphs; None unless shapes are static, in one process on a GPU."""
        on_gpu = self._device.type == "cuda" and self.processes == 1
        if not (self.capacities and self.graphs == "auto" and on_gpu):
            return None
        if self._capture is None or self._capture.device != self._device:
            self._capture = CudaGraphCapture(self._device)
        return self._capture

"""How an iteration is carried out, whatever is learned in it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from devrf.data.batch import Pixels
from devrf.engine.ddp import average_gradients, share, world_size
from devrf.engine.graphs import Capturer, CudaGraphCapture, GraphedStep, Graphs
from devrf.engine.micro_batching import MicroBatching
from devrf.engine.parallel_batch import MetricAccumulator, ParallelBatch
from devrf.engine.streams import StreamParallel
from devrf.ops.adam import GridAdam
from devrf.ops.dispatch import triton_runs
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.scenes.scene import Views
from devrf.system.out_of_memory import OutOfMemoryError
from devrf.system.profiling import measured, span
from devrf.system.speed import wait


class Learner(Protocol):
    """What is learned."""

    @property
    def optimizer(self) -> GridAdam:
        """What steps on the parameters of all lanes."""
        ...

    def draw(self, lane: ParallelBatch) -> Pixels:
        """The pixels of a lane's coming iteration."""
        ...

    def loss(
        self, lane: ParallelBatch, views: Views, pixels: Pixels
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss of a lane's pixels of ``views``, and its terms by name."""
        ...

    def manual_backward(self, loss: Tensor) -> Any:
        """Add the gradients of a loss to those that are there."""
        ...


class Loop:
    """Iterations, one after another: each one optimiser step on one batch, or on several.

    Several batches that have nothing to do with one another (``lanes``) are learned from side by
    side. Where memory is short a batch is taken in parts. Where Triton runs, iterations are
    steady: lists of samples have a fixed length (``rooms``), gradients, moments and whatever else
    goes from one iteration to the next stay in the same memory, and nothing waits for the device.
    On one GPU each is then a CUDA graph that is replayed.

    Attributes:
        graphs: whether steady iterations are captured in a CUDA graph where that is possible.
        lanes: the batches of an iteration; none before :meth:`renew`.
        parts: how batches are divided when memory runs out.
        sums: of losses and their terms, over the iterations since they were last taken.
    """

    def __init__(self, graphs: Graphs = "auto") -> None:
        self.graphs = graphs
        self.lanes: list[ParallelBatch] = []
        self.parts = MicroBatching()
        self.sums = MetricAccumulator()
        self._rays = 0
        self._device = torch.device("cpu")
        self._side_by_side = StreamParallel()
        self._repeated: GraphedStep | None = None

    @property
    def rooms(self) -> list[SampleCapacity]:
        """How long each lane's lists of samples are; none unless iterations are steady."""
        return [lane.room for lane in self.lanes if lane.room is not None]

    def renew(
        self, rays: int, lanes: Sequence[Sequence[Tensor]], density: Tensor, optimizer: GridAdam
    ) -> None:
        """Get ready for iterations on other tensors than before.

        Args:
            rays: of a batch, in all processes together.
            lanes: what is learned from each of the batches of an iteration.
            density: the grid that samples are looked up in; it tells whether Triton runs.
            optimizer: what steps on them; it has them.
        """
        self.let_go()
        self._rays, self._device = rays, density.device
        self.lanes = [ParallelBatch(number, learned) for number, learned in enumerate(lanes)]
        if triton_runs(density):
            self._make_rooms()
            optimizer.keep_gradients()

    def let_go(self) -> None:
        """Let go of what only iterations need: a captured one holds memory of its own."""
        self.lanes, self.sums, self._repeated = [], MetricAccumulator(), None

    def once(self, learner: Learner, views: Views, optimizer: LightningOptimizer) -> None:
        """One iteration.

        Args:
            learner: what is learned.
            views: the images of all pixels.
            optimizer: the learner's, as Lightning hands it out: callbacks are asked before it
                steps, or before the whole iteration if that is steady.

        Raises:
            OutOfMemoryError: there is no room for the smallest part of a batch; no lane has moved.
        """
        for lane in self.lanes:
            lane.take(learner.draw(lane))
        try:
            if self.rooms:
                self._repeat(learner, views, optimizer)
            else:
                optimizer.zero_grad()
                self._learn(learner, views)
                with span("optimiser"):
                    optimizer.step()
        except OutOfMemoryError:
            optimizer.zero_grad()  # of lanes that had room
            raise

    def look(self) -> None:
        """Fit the lists to what iterations needed, as far as that is known by now."""
        if any([room.look() for room in self.rooms]):  # a list: all of them look
            self._repeated = None  # captured with lists of another length

    def _make_rooms(self) -> None:
        rays = -(-share(self._rays) // self.parts.count)
        for lane in self.lanes:
            lane.room = SampleCapacity(rays, self._device)

    def _learn(self, learner: Learner, views: Views) -> None:
        """The gradients of each lane's batch; losses and terms are added to the sums."""
        pieces = [partial(self._learn_from, lane, learner, views) for lane in self.lanes]
        found = self._side_by_side(pieces, self._device)
        groups = learner.optimizer.param_groups
        average_gradients(p for group in groups for p in group["params"])
        self.sums.add(found)

    def _learn_from(self, lane: ParallelBatch, learner: Learner, views: Views) -> dict[str, Tensor]:
        """The gradients of a lane's batch, its loss and its terms."""
        assert lane.pixels is not None

        def backward(total: Tensor) -> None:
            with span("backward"):
                learner.manual_backward(total)

        total, terms = self.parts.gradients(
            lambda part: learner.loss(lane, views, part),
            lane.pixels,
            backward,
            lambda: self._divided(lane, learner.optimizer),
        )
        return {"loss": total.detach(), **terms}

    def _divided(self, lane: ParallelBatch, optimizer: GridAdam) -> None:
        """Begin a lane's iteration anew in smaller parts, which are those of all lanes."""
        wait(self._device)  # other lanes may be at work in their rooms
        optimizer.drop_gradients(lane.parameters)
        if self.rooms:
            self._make_rooms()
            self._repeated = None

    def _repeat(self, learner: Learner, views: Views, optimizer: LightningOptimizer) -> None:
        """A steady iteration: the same work on the same tensors, with other pixels in them."""

        def work() -> None:
            self._learn(learner, views)
            with span("optimiser"):
                learner.optimizer.apply()

        if self._repeated is None:
            self._repeated = GraphedStep(work, self._capturer())
        repeated = self._repeated  # which is gone if memory runs out on the way
        # What is replayed shows none of its parts to those who measure them.
        with learner.optimizer.stepping_by(work if measured() else repeated):
            optimizer.step()
        if repeated.is_warm:
            for room in self.rooms:
                room.measure()
        if repeated.failed:
            self.graphs = "off"  # one warning is enough

    def _capturer(self) -> Capturer | None:
        """How iterations are captured: on one GPU, if at all."""
        possible = self.graphs == "auto" and self._device.type == "cuda" and world_size() == 1
        return CudaGraphCapture(self._device) if possible else None

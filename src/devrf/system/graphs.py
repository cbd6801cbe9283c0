"""Repeated work as a CUDA graph: Python runs it once, later iterations replay its kernels.

A graph repeats the captured kernel launches on the same memory. The work must therefore read its
inputs from the same tensors each time, write its results in place, and take no number from Python
that changes between iterations. :class:`devrf.engine.loop.Loop` meets these conditions.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import torch

log = logging.getLogger(__name__)

Graphs = Literal["auto", "off"]
Work = Callable[[], None]


class CudaGraphCapture:
    """Captures on a CUDA device, on one side stream that warm-ups share.

    cuBLAS keeps a workspace for each stream that it was used on.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]

    def warm_up(self, work: Work) -> None:
        """Run ``work`` before its capture, on the side stream.

        Autograd nodes that it creates must not refer to the default stream.
        """
        present = torch.cuda.current_stream(self.device)
        self._side.wait_stream(present)
        try:
            with torch.cuda.stream(self._side):
                work()
        finally:
            present.wait_stream(self._side)

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        """A graph of ``work``, with a memory pool of its own; capturing does not run it.

        Other threads may use the device meanwhile.
        """
        index, before = self.device.index or 0, torch.cuda.current_stream(self.device)
        graph, pool = torch.cuda.CUDAGraph(), torch.cuda.graph_pool_handle()
        generator = torch.cuda.default_generators[index]
        state = generator.clone_state()
        captured = False
        try:
            with torch.cuda.device(self.device), torch.cuda.stream(self._side):
                # As `torch.cuda.graph`, but older versions of it collect garbage first: 0.2 s.
                torch.cuda.synchronize()
                torch.cuda.empty_cache()
                graph.capture_begin(pool, capture_error_mode="thread_local")
                try:
                    work()
                finally:
                    graph.capture_end()
            captured = True
        finally:
            # After a failed capture torch leaves the capturing stream current, its allocator
            # filling the graph's pool, and its generator waiting for the capture's end.
            torch.cuda.set_stream(before)
            if not captured:
                generator.graphsafe_set_state(state)
                with suppress(RuntimeError):  # it has already ended
                    torch._C._cuda_endAllocateToPool(index, pool)
        return graph


class GraphedStep:
    """Runs the same work at each call: from Python for some warm-up calls, then from a graph.

    If the capture fails, a warning says why, and every later call runs the work from Python.

    Attributes:
        failed: whether the capture failed.
    """

    # Kernels are compiled, and library workspaces and constants allocated, before the capture.
    WARM_UP = 3

    def __init__(
        self, work: Work, capturer: CudaGraphCapture | None, warm_up: int | None = None
    ) -> None:
        """Prepare to run ``work``, which must not wait for the device.

        Args:
            work: what each call runs.
            capturer: captures it; None: never capture.
            warm_up: warm-up calls; None: ``WARM_UP``.
        """
        self._warm_up = self.WARM_UP if warm_up is None else warm_up
        self._work = work
        self._capturer = capturer
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self.failed = False

    @property
    def is_warm(self) -> bool:
        """Whether the last warm-up call has just been made: the next call captures."""
        return self._calls == self._warm_up

    @property
    def has_captured(self) -> bool:
        """Whether the last call has just captured the graph that it replayed."""
        return self._graph is not None and self._calls == self._warm_up + 1

    def __call__(self) -> None:
        """Run the work once."""
        self._calls += 1
        if self._graph is None and self._capturer is not None:
            if self._calls <= self._warm_up:
                self._capturer.warm_up(self._work)
                return
            self._try(self._capturer)
        if self._graph is not None:
            self._graph.replay()
        else:
            self._work()

    def _try(self, capturer: CudaGraphCapture) -> None:
        try:
            self._graph = capturer.capture(self._work)
        except Exception as error:
            self._capturer, self.failed = None, True
            log.warning("graphs: iterations are done one by one, not replayed (%s)", _cause(error))


def _cause(error: BaseException) -> str:
    """What came first, in one line: ending an invalid capture raises an error of its own."""
    while error.__context__ is not None:
        error = error.__context__
    return f"{type(error).__name__}: {error}".splitlines()[0]

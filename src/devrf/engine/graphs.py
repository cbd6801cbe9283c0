"""Repeated work as a CUDA graph: Python runs it once, later iterations replay its kernels.

A graph repeats the captured kernel launches on the same memory. The work must therefore read its
inputs from the same tensors each time, write its results in place, and take no number from Python
that changes between iterations. :class:`devrf.engine.loop.Loop` meets these conditions.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Literal

import torch

log = logging.getLogger(__name__)

Graphs = Literal["auto", "off"]
Work = Callable[[], None]


class CudaGraphCapture:
    """Captures on a CUDA device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def warm_up(self, work: Work) -> None:
        """Run ``work`` before its capture, on a side stream.

        Autograd nodes that it creates must not refer to the default stream.
        """
        present = torch.cuda.current_stream(self.device)
        side = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        side.wait_stream(present)
        with torch.cuda.stream(side):
            work()
        present.wait_stream(side)

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        """A graph of ``work``, with a memory pool of its own; capturing does not run it."""
        before = torch.cuda.current_stream(self.device)
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.device(self.device), torch.cuda.graph(graph):
                work()
        finally:
            # After a failed capture torch leaves the capturing stream current.
            torch.cuda.set_stream(before)
        return graph


class GraphedStep:
    """Runs the same work at each call: from Python for ``WARM_UP`` calls, then from a graph.

    If the capture fails, a warning says why, and every later call runs the work from Python.

    Attributes:
        failed: whether the capture failed.
    """

    # Kernels are compiled, and library workspaces and constants allocated, before the capture.
    WARM_UP = 3

    def __init__(self, work: Work, capturer: CudaGraphCapture | None) -> None:
        """Prepare to run ``work``, which must not wait for the device.

        Args:
            work: what each call runs.
            capturer: captures it; None: never capture.
        """
        self._work = work
        self._capturer = capturer
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self.failed = False

    @property
    def is_warm(self) -> bool:
        """Whether the last warm-up call has just been made: the next call captures."""
        return self._calls == self.WARM_UP

    def __call__(self) -> None:
        """Run the work once."""
        self._calls += 1
        if self._graph is None and self._capturer is not None:
            if self._calls <= self.WARM_UP:
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
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning("graphs: iterations are done one by one, not replayed (%s)", reason)

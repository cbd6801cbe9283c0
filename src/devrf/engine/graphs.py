"""Work that is the same each time, replayed from a CUDA graph: Python's part is done once.

A captured graph repeats what was launched, on the tensors that it was launched on. So the work
must find its input in the same memory each time, leave its results in place, and let no number
that changes come from Python. devrf.engine.stage sees to that.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Literal, Protocol

import torch

log = logging.getLogger(__name__)

Graphs = Literal["auto", "off"]
Work = Callable[[], None]


class Graph(Protocol):
    """What was captured."""

    def replay(self) -> None:
        """Do it once more."""
        ...


class Capturer(Protocol):
    """How work is captured."""

    def warm_up(self, work: Work) -> None:
        """Do ``work``, as it has to be done before it is captured."""
        ...

    def capture(self, work: Work) -> Graph:
        """A graph of ``work``, which is not done."""
        ...


class CudaGraphCapture:
    """Captures on a CUDA device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def warm_up(self, work: Work) -> None:
        """Do ``work`` on a stream of its own: nothing that is captured may be tied to another."""
        present = torch.cuda.current_stream(self.device)
        side = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        side.wait_stream(present)
        with torch.cuda.stream(side):
            work()
        present.wait_stream(side)

    def capture(self, work: Work) -> Graph:
        """Capture ``work``, with memory of its own."""
        before = torch.cuda.current_stream(self.device)
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.device(self.device), torch.cuda.graph(graph):
                work()
        finally:
            # A capture that fails does not leave its own stream by itself.
            torch.cuda.set_stream(before)
        return graph


class GraphedStep:
    """Does the same work at each call: as it is for a few times, then from a graph.

    Where it cannot be captured a warning says why, and it is done as it is ever after.

    Attributes:
        failed: whether that has happened.
    """

    # So that kernels are compiled, libraries have their workspaces, and constants are there.
    WARM_UP = 3

    def __init__(self, work: Work, capturer: Capturer | None) -> None:
        """Take on ``work``.

        Args:
            work: what to do; it must not wait for the device.
            capturer: makes a graph of it; None: never.
        """
        self._work = work
        self._capturer = capturer
        self._calls = 0
        self._graph: Graph | None = None
        self.failed = False

    @property
    def is_warm(self) -> bool:
        """Whether the work has just been done often enough to be captured the next time."""
        return self._calls == self.WARM_UP

    def __call__(self) -> None:
        """Do the work once."""
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

    def _try(self, capturer: Capturer) -> None:
        try:
            self._graph = capturer.capture(self._work)
        except Exception as error:
            self._capturer, self.failed = None, True
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning("graphs: iterations are done one by one, not replayed (%s)", reason)

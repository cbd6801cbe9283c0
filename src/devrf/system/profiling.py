"""Which part of the work is being done, for whoever measures it.

Code that is worth a row in a table says so with ``with span("warp"):``. When nobody measures, that
costs a fraction of a microsecond, and nothing on a device. Inside :func:`measuring` a
:class:`Stopwatch` notes when each part begins and ends.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Literal

import torch
from torch import Tensor

Part = Literal[
    "batch",  # drawing rays and what the images say about them
    "sampling",  # finding the samples that can be seen
    "warp",  # points of a moment → canonical space
    "density",  # the density's look-ups
    "decoder",  # the features' look-ups and the colour network
    "compositing",  # weights, and sums along rays
    "losses",
    "backward",  # all of autograd's work
    "optimiser",  # the total variation's gradient, and Adam's step
]
# What lies between the parts: the loop itself, and the framework around it.
OVERHEAD: Literal["overhead"] = "overhead"

Count = Literal[
    "tested",  # samples whose opacity was looked up
    "opaque",  # those that are opaque enough to matter
    "reached",  # those of them that something of their ray is left for
    "heavy",  # those of them whose colour was computed
]


class Stopwatch:
    """How long each part took, a part inside another counting for itself alone.

    On a CPU these are wall-clock times. On a CUDA device they are times of the device, between
    events in its queue: a part that keeps the device waiting for launches is charged for that.

    Attributes:
        counts: what was counted, by name; tensors if the numbers are known to a device alone.
    """

    def __init__(self, device: torch.device) -> None:
        """Start nothing yet.

        Args:
            device: where the work is done.
        """
        self.counts: dict[Count, int | Tensor] = {}
        self._cuda = device.type == "cuda"
        self._open: list[str] = [OVERHEAD]
        self._marks: list[tuple[str, float | torch.cuda.Event]] = []

    def begin(self, part: str) -> None:
        """From now on ``part`` is being done, within what was being done before."""
        self._open.append(part)
        self._mark()

    def end(self) -> None:
        """The part that began last is done; what it was a part of goes on."""
        self._open.pop()
        self._mark()

    def _mark(self) -> None:
        self._marks.append((self._open[-1] if self._open else "", self._now()))

    def _now(self) -> float | torch.cuda.Event:
        if not self._cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
        event.record()
        return event

    def seconds(self) -> dict[str, float]:
        """Seconds by part, ``overhead`` included; waits for the device."""
        if self._cuda:
            torch.cuda.synchronize()
        spent: dict[str, float] = {}
        for (part, begin), (_, end) in zip(self._marks, self._marks[1:], strict=False):
            spent[part] = spent.get(part, 0.0) + _between(begin, end)
        return spent


def _between(begin: float | torch.cuda.Event, end: float | torch.cuda.Event) -> float:
    if isinstance(begin, float) or isinstance(end, float):
        assert isinstance(begin, float) and isinstance(end, float)
        return end - begin
    return float(begin.elapsed_time(end)) / 1000


_watch: ContextVar[Stopwatch | None] = ContextVar("watch", default=None)
_nothing = nullcontext()


class _Span:
    __slots__ = ("part", "watch")

    def __init__(self, watch: Stopwatch, part: str) -> None:
        self.watch = watch
        self.part = part

    def __enter__(self) -> None:
        self.watch.begin(self.part)

    def __exit__(self, *_: object) -> None:
        self.watch.end()


def span(part: Part) -> AbstractContextManager[None]:
    """What is done inside is ``part`` of the work; parts may lie inside one another."""
    watch = _watch.get()
    return _nothing if watch is None else _Span(watch, part)


def tally(name: Count, count: int | Tensor) -> None:
    """Add ``count``, a number or a tensor () on the device, to what whoever measures counts."""
    watch = _watch.get()
    if watch is not None:
        watch.counts[name] = watch.counts.get(name, 0) + count


def measured() -> bool:
    """Is somebody measuring? Then the parts must be done one by one, not replayed as a whole."""
    return _watch.get() is not None


@contextmanager
def measuring(device: torch.device) -> Iterator[Stopwatch]:
    """Measure what is done inside, in this thread.

    Args:
        device: where the work is done.

    Yields:
        The stopwatch; to be read once the block has ended.
    """
    watch = Stopwatch(device)
    token = _watch.set(watch)
    watch._mark()
    try:
        yield watch
    finally:
        _watch.reset(token)
        watch.end()

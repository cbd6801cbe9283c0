"""Work that a CUDA device does at the same time, since a piece of it is too small to fill it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from devrf.system.profiling import measured

Result = TypeVar("Result")


class StreamParallel:
    """Does pieces of work that do not depend on one another.

    On a CUDA device the first is done on the present stream, each further one on a stream of its
    own: those wait for the present one before anything begins, and it waits for them at the end.
    What was made before the fork is there for all, what they give may be used after the join,
    and in a captured CUDA graph they are branches.

    A piece allocates from its own stream's memory, which is not reused before the next fork; that
    fork waits for what read it after the join. Autograd runs backward on the stream of the forward
    pass. Gradients that pieces leave behind must be of different tensors.

    On a CPU, whose cores each operation uses already, and where parts are measured, which must
    not overlap, one piece follows the other.
    """

    def __init__(self) -> None:
        # Made once: the allocator keeps the memory of each stream apart.
        self._streams: list[torch.cuda.Stream] = []

    def __call__(
        self, pieces: Sequence[Callable[[], Result]], device: torch.device
    ) -> list[Result]:
        """What each of some pieces of work on ``device`` gives."""
        if len(pieces) == 1 or device.type != "cuda" or measured():
            return [piece() for piece in pieces]
        present, streams = torch.cuda.current_stream(device), self._further(len(pieces) - 1, device)
        for stream in streams:
            stream.wait_stream(present)
        try:
            results = [pieces[0]()]
            for stream, piece in zip(streams, pieces[1:], strict=True):
                with torch.cuda.stream(stream):
                    results.append(piece())
        finally:
            for stream in streams:
                present.wait_stream(stream)
        return results

    def _further(self, count: int, device: torch.device) -> list[torch.cuda.Stream]:
        while len(self._streams) < count:
            self._streams.append(torch.cuda.Stream(device))  # type: ignore[no-untyped-call]
        return self._streams[:count]

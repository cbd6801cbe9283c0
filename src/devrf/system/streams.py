"""Independent pieces of work at the same time, on several CUDA streams.

A single batch of rays is often too small to occupy a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from devrf.system.profiling import measured

Result = TypeVar("Result")


class StreamParallel:
    """Runs pieces of work that do not depend on one another.

    On a CUDA device the first piece runs on the current stream, each further one on a stream of
    its own. These streams first wait for the current one, and it waits for them at the end. Each
    piece may therefore use everything computed before, and its results may be used after; in a
    captured CUDA graph the pieces become parallel branches.

    A side stream has its own memory in the allocator. It is not reused before the next call, which
    begins by waiting for whatever read the results. Autograd runs the backward pass on the stream
    of the forward pass, so pieces must accumulate gradients into different tensors.

    On a CPU, where each operation uses all cores, and under a profiler, which attributes time to
    parts that must not overlap, the pieces run one after another.
    """

    def __init__(self) -> None:
        # Reused at each call: the allocator keeps the memory of each stream apart.
        self._streams: list[torch.cuda.Stream] = []

    def __call__(
        self, pieces: Sequence[Callable[[], Result]], device: torch.device
    ) -> list[Result]:
        """The results of ``pieces`` on ``device``, in order."""
        if len(pieces) == 1 or device.type != "cuda" or measured():
            return [piece() for piece in pieces]
        while len(self._streams) < len(pieces) - 1:
            self._streams.append(torch.cuda.Stream(device))  # type: ignore[no-untyped-call]
        present, streams = torch.cuda.current_stream(device), self._streams[: len(pieces) - 1]
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

"""What is asked of CUDA around a capture; torch.cuda's streams and graphs are stand-ins."""

from __future__ import annotations

import logging
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from devrf.accel.graphs import CudaGraphCapture, GraphedStep


class Stream:
    def __init__(self, *_: Any) -> None:
        self.waited_for: list[Stream] = []

    def wait_stream(self, other: Stream) -> None:
        self.waited_for.append(other)


class Cuda:
    """Records what a capture asks for."""

    def __init__(self) -> None:
        self.current = self.usual = Stream()
        self.captures: list[dict[str, Any]] = []
        self.left: list[Any] = []

    @contextmanager
    def stream(self, stream: Stream) -> Any:
        before, self.current = self.current, stream
        yield
        self.current = before  # as torch does: not after an error inside

    @contextmanager
    def graph(self, graph: Any, **options: Any) -> Any:
        self.captures.append(options)
        self.current = options["stream"]
        try:
            yield
        except ValueError:
            raise RuntimeError("capture_end: the capture was invalidated") from None
        self.current = self.usual


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Cuda:
    cuda = Cuda()
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", cuda.stream)
    monkeypatch.setattr(torch.cuda, "graph", cuda.graph)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", object)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: "a pool")
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: cuda.current)
    monkeypatch.setattr(torch.cuda, "set_stream", lambda stream: setattr(cuda, "current", stream))
    monkeypatch.setattr(torch.cuda, "device", lambda device: cuda.stream(cuda.current))
    monkeypatch.setattr(
        torch._C, "_cuda_endAllocateToPool", lambda *given: cuda.left.append(given), raising=False
    )
    return cuda


@pytest.fixture
def capture(cuda: Cuda) -> CudaGraphCapture:
    return CudaGraphCapture(torch.device("cuda", 0))


def fail() -> None:
    raise ValueError("a tensor of data's shape")


def test_warm_ups_and_captures_share_one_stream(cuda: Cuda, capture: CudaGraphCapture) -> None:
    seen: list[Stream] = []
    for _ in range(2):
        capture.warm_up(lambda: seen.append(cuda.current))
    capture.capture(lambda: seen.append(cuda.current))
    assert len({id(stream) for stream in seen}) == 1 and seen[0] is not cuda.usual
    assert cuda.captures == [
        {"pool": "a pool", "stream": seen[0], "capture_error_mode": "thread_local"}
    ]
    assert cuda.current is cuda.usual and cuda.left == []


def test_a_warm_up_that_fails_is_waited_for(cuda: Cuda, capture: CudaGraphCapture) -> None:
    with pytest.raises(ValueError):
        capture.warm_up(fail)
    assert len(cuda.usual.waited_for) == 1


def test_after_a_failed_capture_stream_and_allocator_are_as_before(
    cuda: Cuda, capture: CudaGraphCapture
) -> None:
    with pytest.raises(RuntimeError):
        capture.capture(fail)
    assert cuda.current is cuda.usual
    assert cuda.left == [(0, "a pool")]


def test_the_warning_names_the_first_error_not_that_of_ending_the_capture(
    cuda: Cuda, capture: CudaGraphCapture, caplog: pytest.LogCaptureFixture
) -> None:
    calls = []

    def work() -> None:
        calls.append(1)
        if len(calls) == GraphedStep.WARM_UP + 1:
            fail()

    step = GraphedStep(work, capture)
    with caplog.at_level(logging.WARNING):
        for _ in range(GraphedStep.WARM_UP + 1):
            step()
    assert step.failed and len(calls) == GraphedStep.WARM_UP + 2
    assert [record.getMessage() for record in caplog.records] == [
        "graphs: iterations are done one by one, not replayed "
        "(ValueError: a tensor of data's shape)"
    ]

"""The checks of graphs, waits and memory: what they ask of CUDA is stood in for on a CPU.

The stage, its loop and what it does when a capture fails or memory runs out are real.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from devrf.engine.graphs import CudaGraphCapture, Work
from devrf.engine.loop import Loop
from devrf.engine.micro_batching import MicroBatching
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.selfcheck import graph_checks, memory_checks
from devrf.selfcheck.bench import Bench, Way
from devrf.selfcheck.graph_checks import WAITS, capture, waits
from devrf.selfcheck.memory_checks import for_good, in_capture, in_warm_up

# Nothing here needs Triton: lists of fixed length learn the same in PyTorch.
STATIC = Way("torch", "auto")


class Memory:
    """A GPU's memory: while there is a limit, what exceeds it fails."""

    def __init__(self) -> None:
        self.left: int | None = None

    @contextmanager
    def at_most(self, device: torch.device, more: int) -> Iterator[None]:
        self.left = more
        try:
            yield
        finally:
            self.left = None


class Again:
    def __init__(self, work: Work) -> None:
        self.replay = work


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Memory:
    """Graphs that run their work again, and a memory that may be limited."""
    memory = Memory()

    def start(self: CudaGraphCapture, device: torch.device) -> None:
        self.device, self._side = device, None  # type: ignore[assignment]

    def capturer(self: Loop) -> Any:
        self._capture = self._capture or CudaGraphCapture(self._device)
        return self._capture if self.graphs == "auto" else None

    def captured(self: CudaGraphCapture, work: Work) -> Any:
        if memory.left is not None:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB.")
        return Again(work)

    usual = MicroBatching._accumulate

    def accumulate(self: MicroBatching, *given: Any) -> Any:
        # A batch takes 1000 bytes, its parts as much less.
        if memory.left is not None and 1000 / self.count > memory.left:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB.")
        return usual(self, *given)

    monkeypatch.setattr(CudaGraphCapture, "__init__", start)
    monkeypatch.setattr(CudaGraphCapture, "warm_up", lambda self, work: work())
    monkeypatch.setattr(CudaGraphCapture, "capture", captured)
    monkeypatch.setattr(Loop, "capturer", capturer)
    monkeypatch.setattr(MicroBatching, "_accumulate", accumulate)
    monkeypatch.setattr(VoxelStage, "static_shape", lambda self, density: True)
    monkeypatch.setattr(SampleCapacity, "GRAIN", 64)
    monkeypatch.setattr(memory_checks, "at_most", memory.at_most)
    monkeypatch.setattr(memory_checks, "WAY", STATIC)
    monkeypatch.setattr(memory_checks.NoMemory, "_fill", lambda self: None)
    monkeypatch.setattr(graph_checks, "Way", lambda *_: STATIC)
    for name in ("max_memory_allocated", "max_memory_reserved", "memory_reserved"):
        monkeypatch.setattr(torch.cuda, name, lambda device, name=name: 1000 * ("max" in name))
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: None)
    return memory


@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_every_phase_is_captured(bench: Bench, memory: Memory, name: str) -> None:
    found = capture(bench, name)
    assert found.held, found.said
    assert found.figures["captures"] >= found.figures["expected_at_least"] == 2
    assert found.figures["errors"] == []


def test_a_capture_that_fails_is_told_with_its_cause(bench: Bench, memory: Memory) -> None:
    memory.left = 10**6
    found = capture(bench, "canonical")
    assert not found.held and "Tried to allocate 2.00 MiB" in found.said
    (error,) = found.figures["errors"]
    assert error.startswith("Traceback")


def test_memory_that_runs_out_in_warm_up_is_met_with_parts(bench: Bench, memory: Memory) -> None:
    found = in_warm_up(bench)
    assert found.held, found.said
    assert found.figures["batch_bytes"] == 1000 and found.figures["parts"] == 2


def test_memory_that_runs_out_in_capture_leaves_iterations_without_graphs(
    bench: Bench, memory: Memory
) -> None:
    found = in_capture(bench)
    assert found.held and found.said.startswith("went on without graphs"), found.said


def test_memory_that_runs_out_for_good_ends_the_stage_saved(
    bench: Bench, memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_checks, "SMALL", 10)
    found = for_good(bench)
    assert found.held, found.said
    assert found.said.startswith("ended with 1 progress file(s): canonical stage: out of memory")


def test_memory_that_suffices_after_all_makes_the_checks_fail(
    bench: Bench, memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def unlimited(device: torch.device, more: int) -> Iterator[None]:
        yield

    monkeypatch.setattr(memory_checks, "at_most", unlimited)
    assert not in_capture(bench).held and not for_good(bench).held


@pytest.fixture
def waiting(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """torch's warnings of waits, while they are asked for; where they are made to occur."""
    asked = {"warn": False, "draw": False, "measure": False}

    def ask(mode: str) -> None:
        asked["warn"] = mode == "warn"

    def wait_in(owner: type, name: str) -> None:
        usual: Callable[..., Any] = getattr(owner, name)

        def waits_too(*given: Any) -> Any:
            if asked["warn"] and asked[name]:
                warnings.warn(WAITS, stacklevel=2)
            return usual(*given)

        monkeypatch.setattr(owner, name, waits_too)

    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", ask)
    wait_in(VoxelStage, "draw_pixels")
    asked["draw_pixels"] = asked.pop("draw")
    wait_in(SampleCapacity, "measure")
    return asked


@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_waits_within_iterations_are_counted_and_located(
    bench: Bench, waiting: dict[str, bool], name: str
) -> None:
    waiting["draw_pixels"] = True
    found = waits(bench, name, STATIC)
    assert not found.held and not waiting["warn"]
    (first, *_) = found.figures["places"]
    assert first["part"] == "iteration" and first["place"].startswith("devrf/methods/devrf/")
    # Every iteration of the steps that were watched, once.
    assert first["count"] == found.figures["steps"] * 5
    assert f"{first['count']} waits within iterations" in found.said


def test_without_waits_the_check_holds(bench: Bench, waiting: dict[str, bool]) -> None:
    waiting["measure"] = True
    found = waits(bench, "canonical", STATIC)
    assert found.held and found.said.startswith("0 waits within iterations"), found.said


def test_where_something_waited() -> None:
    stack = graph_checks.traceback.StackSummary.from_list(
        [
            (str(graph_checks.PACKAGE / "engine" / "stage.py"), 1, "training_step", "x"),
            (str(graph_checks.PACKAGE / "rendering" / "sample_capacity.py"), 7, "measure", "y"),
            ("elsewhere.py", 3, "show", "z"),
        ]
    )
    place = "devrf/rendering/sample_capacity.py:7 y"
    assert graph_checks.place_of(stack, "a.py", 1) == ("adapting", place)
    outside = graph_checks.traceback.StackSummary.from_list([("elsewhere.py", 3, "show", "z")])
    assert graph_checks.place_of(outside, "a.py", 1) == ("between", "a.py:1 ")

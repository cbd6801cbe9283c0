"""The checks of the machine: on a GPU all of them, on a CPU with stand-ins for what CUDA does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from devrf import selfcheck
from devrf.accel.graphs import CudaGraphCapture, Work
from devrf.engine.loop import Loop
from devrf.engine.micro_batching import MicroBatching
from devrf.errors import DevrfError
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.selfcheck import EXACT, SmallScene, capture, rendering, resume, short_memory, small_scene


@pytest.fixture(scope="module")
def gpu_scene() -> SmallScene:
    return small_scene(torch.device("cuda", 0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", selfcheck.CHECKS)
def test_a_check_passes(name: str, gpu_scene: SmallScene) -> None:
    selfcheck.CHECKS[name](gpu_scene)


@pytest.fixture(scope="module")
def scene() -> SmallScene:
    """As small as learning allows."""
    cpu = torch.device("cpu")
    return SmallScene(cpu, 0, 24, 8, 3, 16, (4, 6), rays=192, decoder=16, iterations=20)


@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_a_stage_that_a_signal_stops_goes_on_to_equal_bits(scene: SmallScene, name: str) -> None:
    assert resume(scene, name, EXACT).endswith("equal bits")


def test_a_stage_that_goes_on_otherwise_is_noticed(
    scene: SmallScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = VoxelStage._reseed

    def other(self: VoxelStage) -> None:
        usual(self)
        if self.trainer.ckpt_path:
            self.generator.manual_seed(5)

    monkeypatch.setattr(VoxelStage, "_reseed", other)
    with pytest.raises(DevrfError, match="came to other fields"):
        resume(scene, "canonical", EXACT)


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
    """Graphs that run their work again, and a memory in which a batch takes 1000 bytes.

    The stage, its loop and what it does when a capture fails or memory runs out are real.
    """
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
    monkeypatch.setattr(selfcheck, "require_gpu", lambda scene, reason: None)
    monkeypatch.setattr(selfcheck, "at_most", memory.at_most)
    # Lists of fixed length learn the same in PyTorch.
    monkeypatch.setattr(selfcheck, "FAST", selfcheck.Variant("torch", "auto"))
    for name in ("max_memory_reserved", "memory_reserved"):
        monkeypatch.setattr(torch.cuda, name, lambda device, name=name: 1000 * ("max" in name))
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: None)
    return memory


@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_every_resolution_is_captured(scene: SmallScene, memory: Memory, name: str) -> None:
    assert int(capture(scene, name).split()[0]) >= 2


def test_a_capture_that_fails_is_noticed(scene: SmallScene, memory: Memory) -> None:
    memory.left = 10**6
    with pytest.raises(DevrfError, match="a capture failed"):
        capture(scene, "canonical")


def test_memory_that_runs_out_is_met_with_parts_or_without_graphs(
    scene: SmallScene, memory: Memory
) -> None:
    assert short_memory(scene, "warm-up") == "batches were split into 2 micro-batches"
    assert short_memory(scene, "capture") == "went on without graphs"


def test_pictures_are_compared(
    scene: SmallScene, memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selfcheck, "PICTURES", [("torch", True, 1e-6)])
    assert rendering(scene).startswith("0 off")
    monkeypatch.setattr(selfcheck, "PICTURES", [("torch", True, -1.0)])
    with pytest.raises(DevrfError, match="off PyTorch's picture"):
        rendering(scene)

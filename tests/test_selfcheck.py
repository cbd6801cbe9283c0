"""The checks of the machine: on a GPU all of them, on a CPU with a stand-in for CUDA's graphs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from devrf import selfcheck
from devrf.engine.loop import Loop
from devrf.errors import DevrfError
from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.rendering.sample_capacity import SampleCapacity
from devrf.selfcheck import EXACT, FAST, SmallScene, capture, rendering, resume, small_scene
from devrf.system.graphs import CudaGraphCapture, Work
from devrf.system.memory import free_cache

GPU = torch.device("cuda", 0)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.fixture(scope="module")
def gpu_scene() -> SmallScene:
    return small_scene(GPU)


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("name", selfcheck.CHECKS)
def test_a_check_passes(name, gpu_scene):
    selfcheck.CHECKS[name](gpu_scene)


@contextmanager
def at_most(more: int) -> Iterator[None]:
    """Within the block torch's allocator may hold ``more`` bytes beside what it holds now."""
    free_cache(GPU)
    total = torch.cuda.get_device_properties(GPU).total_memory
    limit = torch.cuda.memory_reserved(GPU) + more
    torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total), GPU)
    try:
        yield
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, GPU)


class ScarceWarmUp(CudaGraphCapture):
    """Memory is short in the third warm-up.

    The first makes gradients and moments, which stay; the second takes a batch alone, and is
    measured. The third has three quarters of that.
    """

    warm_ups = taken = 0

    def warm_up(self, work: Work) -> None:
        self.warm_ups += 1
        if self.warm_ups == 3:
            with at_most(3 * self.taken // 4):
                super().warm_up(work)
            return
        free_cache(GPU)
        before = torch.cuda.memory_reserved(GPU)
        torch.cuda.reset_peak_memory_stats(GPU)
        super().warm_up(work)
        self.taken = torch.cuda.max_memory_reserved(GPU) - before


class ScarceCapture(CudaGraphCapture):
    """There is no memory for the first capture."""

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        with at_most(0):
            return super().capture(work)


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("capturer", [ScarceWarmUp, ScarceCapture])
def test_all_is_learned_when_memory_runs_out(gpu_scene, capturer):
    stage = gpu_scene.stage("canonical", FAST)
    stage.loop._capture = capturer(GPU)
    losses = gpu_scene.learn(stage, FAST)
    assert stage.iteration == stage.total_iterations
    assert all(map(math.isfinite, losses)) and min(losses) < losses[0]
    if capturer is ScarceCapture:
        assert stage.loop.graphs == "off"
    else:
        assert stage.loop.micro_batching.count > 1


@pytest.fixture(scope="module")
def scene() -> SmallScene:
    return small_scene(torch.device("cpu"))


def test_a_stage_that_a_signal_stops_goes_on_to_equal_bits(scene, monkeypatch):
    assert resume(scene, "canonical", EXACT).endswith("equal bits")
    usual = VoxelStage._reseed

    def other(self: VoxelStage) -> None:
        usual(self)
        if self.trainer.ckpt_path:
            self.generator.manual_seed(5)

    monkeypatch.setattr(VoxelStage, "_reseed", other)
    with pytest.raises(DevrfError, match="came to other fields"):
        resume(scene, "canonical", EXACT)


class Again:
    def __init__(self, work: Work) -> None:
        self.replay = work


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Graphs that run their work again; the stage and its loop are real."""

    def start(self: CudaGraphCapture, device: torch.device) -> None:
        self.device, self._side = device, None  # type: ignore[assignment]

    def capturer(self: Loop) -> Any:
        return CudaGraphCapture(self._device) if self.graphs == "auto" else None

    monkeypatch.setattr(CudaGraphCapture, "__init__", start)
    monkeypatch.setattr(CudaGraphCapture, "warm_up", lambda self, work: work())
    monkeypatch.setattr(CudaGraphCapture, "capture", lambda self, work: Again(work))
    monkeypatch.setattr(Loop, "capturer", capturer)
    monkeypatch.setattr(VoxelStage, "static_shape", lambda self, density: True)
    monkeypatch.setattr(SampleCapacity, "GRAIN", 64)
    monkeypatch.setattr(selfcheck, "require_gpu", lambda scene, reason: None)
    monkeypatch.setattr(selfcheck, "FAST", selfcheck.Variant("auto"))
    return monkeypatch


def test_every_resolution_is_captured(scene, graphs):
    assert int(capture(scene, "deformation").split()[0]) >= 2

    def short(self: CudaGraphCapture, work: Work) -> Any:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 MiB.")

    graphs.setattr(CudaGraphCapture, "capture", short)
    with pytest.raises(DevrfError, match="a capture failed"):
        capture(scene, "canonical")


def test_pictures_are_compared(scene, graphs):
    assert rendering(scene).startswith("0 off")
    graphs.setattr(selfcheck, "PICTURE_LIMIT", -1.0)
    with pytest.raises(DevrfError, match="off the CPU's picture"):
        rendering(scene)

"""Static-shape iterations can be replayed from a graph, and learn the same then.

The kernels run in Triton's interpreter. A stand-in for CUDA graphs runs the work again at each
replay, and compares everything that a graph would have fixed at its capture. What is asked of CUDA
around a capture is tested on stand-ins for its streams and graphs.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from devrf.accel import blocks
from devrf.accel.graphs import CudaGraphCapture, GraphedStep, Work
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings
from devrf.ops.dispatch import Kind, using
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.sample_capacity import SampleCapacity

pytest.importorskip("triton")

SMALL = Architecture(channels=4, width=8, frequencies=1, search_alpha_init=1e-2)
# Few rays through coarse grids: the interpreter is slow. Total variation of the fine grids, so
# that every kernel has work.
SCHEDULE = CanonicalSchedule(
    search_iterations=3,
    search_side=5,
    visual_hull_init=True,
    iterations=3,
    side=5,
    upsample_at=(),
    decay_iterations=6,
    rays=5,
)
LOSS = {"color": 1.0, "per_sample_color": 0.1, "entropy": 0.01}
MOVING = DeformationSchedule(levels=(Level(3, 1),), rays=5)
MOTION = MotionSettings(learning_rate=2e-3, views="one", occupancy_every=2)


def canonical() -> ScheduledStage:
    return CanonicalStage(
        SCHEDULE, SMALL, search_loss=LOSS, fine_loss={**LOSS, "tv": 1e-3}, iterations_per_step=2
    )


def moving(rest: LoadedCheckpoint) -> ScheduledStage:
    # Coarse, for the interpreter's sake.
    rest = copy.deepcopy(rest)
    model = rest.model
    model.canonical.resize(6**3)
    model.occupancy = Occupancy.full((5, 6, 4), model.canonical.box)
    model.settings = replace(model.settings, step=1.0, alpha_threshold=1e-2)
    return DeformationStage(rest, MOVING, MOTION, iterations_per_step=2)


@pytest.fixture(params=["canonical", "deformation"])
def build(request: pytest.FixtureRequest, rest: LoadedCheckpoint) -> Callable[[], ScheduledStage]:
    """Makes a stage."""
    return canonical if request.param == "canonical" else lambda: moving(rest)


@pytest.fixture(autouse=True)
def short_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter is slow on padding, too."""
    monkeypatch.setattr(SampleCapacity, "VISIBLE", 32)
    monkeypatch.setattr(SampleCapacity, "GRAIN", 64)
    monkeypatch.setattr(GraphedStep, "WARM_UP", 1)


# Operations that wait for the device, or whose results have a shape that depends on data.
WAITING = {
    "aten::nonzero",
    "aten::_local_scalar_dense",
    "aten::item",
    "aten::masked_select",
    "aten::unique_consecutive",
    "aten::_unique2",
    "aten::is_nonzero",
    "aten::equal",
    # A tensor of Python's numbers is copied from the host.
    "aten::lift_fresh",
}


class Watch(TorchDispatchMode):
    """Records operations, and which of their memory existed before."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[Any] = []
        self._made: dict[int, Tensor] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name().split(".")[0]
        assert name not in WAITING, f"{name} waits for the device"
        tensors = [a for a in args if isinstance(a, Tensor)]
        if name in {"aten::index", "aten::index_put", "aten::index_put_"}:
            for index in args[1]:
                assert index is None or index.dtype not in (torch.bool, torch.uint8), "a mask"
        if name == "aten::repeat_interleave":
            assert (kwargs or {}).get("output_size") is not None
        self.note(name, args, kwargs)
        result = func(*args, **(kwargs or {}))
        given = {t.untyped_storage().data_ptr() for t in tensors}
        for tensor in result if isinstance(result, tuple | list) else (result,):
            if isinstance(tensor, Tensor) and tensor.untyped_storage().data_ptr() not in given:
                # Kept alive, so that its memory is not reused.
                self._made[tensor.untyped_storage().data_ptr()] = tensor
        return result

    def note(self, name: str, args: Any, kwargs: Any) -> None:
        """An operation with all that a graph keeps of it: shapes, numbers, and old memory."""
        self.done.append((name, [self._kept(a) for a in args], sorted(kwargs or {})))

    def _kept(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            place = value.data_ptr()
            old = value.untyped_storage().data_ptr() not in self._made
            return tuple(value.shape), value.dtype, place if old else "made here"
        if isinstance(value, list | tuple):
            return [self._kept(one) for one in value]
        return value if isinstance(value, int | float | bool | str | None) else type(value)


@contextmanager
def watching() -> Iterator[Watch]:
    """Record torch's operations and kernel launches, but not the interpreter's operations."""
    usual, watch = blocks.run, Watch()

    def run(kernel: Any, programs: int, *args: Any, **constants: Any) -> None:
        watch.note(str(kernel), [programs, *args, *constants.values()], constants)
        with torch.utils._python_dispatch._disable_current_modes():
            usual(kernel, programs, *args, **constants)

    with pytest.MonkeyPatch.context() as patch, watch:
        patch.setattr(blocks, "run", run)
        yield watch


class Again:
    """A stand-in for a CUDA graph: runs the work again, and asserts that it is the same."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self.first: list[Any] | None = None

    def replay(self) -> None:
        with watching() as watch:
            self.work()
        if self.first is None:
            self.first = watch.done
        assert len(watch.done) == len(self.first)
        for now, then in zip(watch.done, self.first, strict=True):
            assert now == then, "a graph would do something else"


class StandIn:
    """Captures with :class:`Again`, and notes what is done."""

    def __init__(self) -> None:
        self.graphs: list[Again] = []
        self.noted: list[str] = []

    def warm_up(self, work: Work) -> None:
        self.noted.append("warm")
        work()

    def capture(self, work: Work) -> Any:
        self.noted.append("captured")
        self.graphs.append(Again(work))
        return self.graphs[-1]


def watched(work: Callable[[], Any]) -> Any:
    """The result of ``work``, which must not wait for the device."""
    with watching():
        return work()


def learn(
    build: Callable[[], ScheduledStage],
    trainer: Callable[..., Trainer],
    datamodule: SceneDataModule,
    kernels: Kind,
    capturer: Any = None,
) -> ScheduledStage:
    torch.manual_seed(3)
    stage = build()
    stage.loop.capturer = lambda: capturer  # type: ignore[method-assign]
    if capturer is not None:
        draw, prepare = stage.draw, stage.prepare
        stage.draw = lambda batch: watched(lambda: draw(batch))  # type: ignore[method-assign]
        stage.prepare = lambda: watched(prepare)  # type: ignore[method-assign]
    with using(kernels):
        trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    return stage


def test_a_replay_is_the_same_work_on_the_same_memory_and_learns_the_same(
    build: Callable[[], ScheduledStage],
    trainer: Callable[..., Trainer],
    datamodule: SceneDataModule,
) -> None:
    capturer = StandIn()
    replayed = learn(build, trainer, datamodule, "triton", capturer)
    # One graph for each phase, or for the level, whose frames share it.
    assert len(capturer.graphs) == (2 if isinstance(replayed, CanonicalStage) else 1)
    assert all(graph.first for graph in capturer.graphs)
    assert replayed.loop.num_captures == len(capturer.graphs)
    static = learn(build, trainer, datamodule, "triton")
    exact = learn(build, trainer, datamodule, "torch")
    assert static.optimizer.keeps_gradients and not exact.optimizer.keeps_gradients
    for name, value in static.state_dict().items():
        if isinstance(value, Tensor):
            assert torch.equal(replayed.state_dict()[name], value), name
    # Sums are in another order, and where a gradient is only rounding, Adam's first steps still
    # have the length of the learning rate.
    for name, value in exact.state_dict().items():
        if isinstance(value, Tensor) and value.is_floating_point():
            off = (static.state_dict()[name] - value).abs()
            assert off.mean() <= 0.02 * value.abs().mean() + 1e-6, name


def test_one_graph_contains_all_frames_that_are_learned_in_parallel(
    rest: LoadedCheckpoint, trainer: Callable[..., Trainer], four_frames: SceneDataModule
) -> None:
    def build() -> ScheduledStage:
        stage = moving(rest)
        # Frame 2 in three iterations, which are left out, then frames 1 and 3.
        stage.schedule = replace(
            MOVING,
            levels=(Level(3, 3, parallel_frames=2),),
            coarse_to_fine=False,
        )
        stage.iteration = 3
        return stage

    capturer = StandIn()
    stage = learn(build, trainer, four_frames, "triton", capturer)
    # Captured in the second iteration, and the same in the third.
    (graph,) = capturer.graphs
    assert graph.first is not None and stage.iteration == 6
    assert stage.scene_model.deformation is not None
    learned = [bool(frame.any()) for frame in stage.scene_model.deformation.to_canonical]
    assert learned == [False, True, False, True]


def test_before_a_capture_lists_have_been_long_enough_for_every_view(
    rest: LoadedCheckpoint,
    trainer: Callable[..., Trainer],
    datamodule: SceneDataModule,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The views take turns: a list that is measured on one of them may be too short for another."""
    capturer = StandIn()
    noted, usual = capturer.noted, DeformationStage.draw

    def draw(self: DeformationStage, batch: Any) -> Any:
        noted.append(f"view {self.iteration % len(self.active[0].pools)}")
        return usual(self, batch)

    # In PyTorch, whose work differs between replays: which view is drawn from is the same.
    monkeypatch.setattr(Again, "replay", lambda self: self.work())
    # Lists of fixed length, in PyTorch: which view is drawn from has nothing to do with kernels.
    monkeypatch.setattr(DeformationStage, "static_shape", lambda self, density: True)
    monkeypatch.setattr(DeformationStage, "draw", draw)
    monkeypatch.setattr(SampleCapacity, "measure", lambda self: noted.append("measured"))
    stage = moving(rest)
    assert isinstance(stage, DeformationStage)
    stage.schedule = replace(MOVING, levels=(Level(3, 2),))
    stage.loop.capturer = lambda: capturer  # type: ignore[assignment,method-assign]
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    done = [what for what in noted if what != "warm"]
    first = ["view 0", "view 1", "measured", "view 0", "captured"]
    assert done[:6] == [*first, "view 1"] and done.count("captured") == 1


def test_what_a_graph_could_not_do_is_noticed() -> None:
    with pytest.raises(AssertionError, match="waits"), watching():
        float(torch.ones(2).sum())
    state: dict[str, Any] = {"x": torch.ones(2)}
    again = Again(lambda: state["x"].add_(1))
    again.replay()
    again.replay()
    state["x"] = torch.ones(2)
    with pytest.raises(AssertionError, match="something else"):
        again.replay()


def test_work_is_captured_after_its_warm_up() -> None:
    capturer = StandIn()
    repeated = GraphedStep(lambda: capturer.noted.append("work"), capturer)  # type: ignore[arg-type]
    for call in range(5):
        repeated()
        assert repeated.is_warm == (call == GraphedStep.WARM_UP - 1)
        assert repeated.has_captured == (call == GraphedStep.WARM_UP)
    assert capturer.noted == ["warm", "work", "captured", *["work"] * 4]
    assert not repeated.failed


class Cuda:
    """A stand-in for CUDA's streams and graphs: records where a capture leaves them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.current = self.usual = SimpleNamespace(wait_stream=lambda other: None)
        self.left: list[Any] = []
        for name, stand_in in {
            "Stream": lambda device: SimpleNamespace(wait_stream=lambda other: None),
            "stream": self.stream,
            "graph": self.graph,
            "CUDAGraph": object,
            "graph_pool_handle": lambda: "a pool",
            "current_stream": lambda device: self.current,
            "set_stream": lambda stream: setattr(self, "current", stream),
            "device": lambda device: self.stream(self.current),
        }.items():
            monkeypatch.setattr(torch.cuda, name, stand_in)
        monkeypatch.setattr(
            torch._C, "_cuda_endAllocateToPool", lambda *pool: self.left.append(pool), raising=False
        )

    @contextmanager
    def stream(self, stream: Any) -> Iterator[None]:
        before, self.current = self.current, stream
        yield
        self.current = before  # as torch does: not after an error inside

    @contextmanager
    def graph(self, graph: Any, **options: Any) -> Iterator[None]:
        self.current = options["stream"]
        try:
            yield
        except ValueError:
            raise RuntimeError("capture_end: the capture was invalidated") from None


def test_after_a_failed_capture_all_is_as_before_and_the_warning_names_the_first_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cuda, calls = Cuda(monkeypatch), []

    def work() -> None:
        calls.append(1)
        if len(calls) == GraphedStep.WARM_UP + 1:
            raise ValueError("a tensor of data's shape\nand more")

    step = GraphedStep(work, CudaGraphCapture(torch.device("cuda", 0)))
    with caplog.at_level(logging.WARNING, logger="devrf"):
        for _ in range(GraphedStep.WARM_UP + 3):
            step()
    # The call that is captured runs the work again, from Python.
    assert step.failed and len(calls) == GraphedStep.WARM_UP + 4
    assert cuda.current is cuda.usual and cuda.left == [(0, "a pool")]
    assert caplog.messages == [
        "graphs: iterations are done one by one, not replayed "
        "(ValueError: a tensor of data's shape)"
    ]

"""Checks of the machine: whether kernels, CUDA graphs and promises hold on its device.

``stage=selfcheck`` makes them one after another, ``pytest -m gpu`` makes the same ones. A check is
a function that returns its figures in a few words, and raises what went wrong.
"""

from __future__ import annotations

import copy
import logging
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from statistics import mean
from typing import Any, Literal

import torch
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import LambdaCallback

from devrf.accel.graphs import CudaGraphCapture, Graphs, Work
from devrf.callbacks import GridUpscaling, LearningRateDecay, PeriodicCheckpoint, StopOnSignal
from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO, LoadedCheckpoint
from devrf.checkpoints.progress import progress_files
from devrf.data.rendered import ProceduralDataModule
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError, did_you_mean
from devrf.evaluation.held_out import background_value
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.tracks import StartAlongFlow
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import MotionSettings, Precision, Sampling
from devrf.ops.check import CASES, Case, compare
from devrf.ops.dispatch import Kind, using
from devrf.rendering.renderer import Renderer
from devrf.system.device import wait
from devrf.system.memory import free_cache

log = logging.getLogger(__name__)


class CheckSkippedError(Exception):
    """The device cannot do the check; the text says why."""


@dataclass(frozen=True)
class Variant:
    """How iterations are carried out.

    Attributes:
        kernels: which implementation of the hot operations runs.
        graphs: whether CUDA graphs are captured.
        precision: what the colour network computes in.
        deterministic: whether only operations are allowed that add in a fixed order.
    """

    kernels: Kind = "torch"
    graphs: Graphs = "off"
    precision: Precision = "float32"
    deterministic: bool = False


PLAIN = Variant()
# What a training on a GPU runs, with an error where ``auto`` would fall back to PyTorch.
FAST = Variant("triton", "auto", "auto")
EXACT = Variant("auto", "auto", "auto", deterministic=True)


@dataclass
class SmallScene:
    """A device, and the embedded robot in small images for it.

    Attributes:
        device: where stages learn.
        seed: of everything that is drawn.
        width: of the images, in pixels; they are three quarters as high.
        views: static ones.
        frames: T of the three moving views.
        side: of the canonical grid at the end.
        sides: of the motion grid, by level.
        rays: of a batch.
        decoder: width of the colour network.
        iterations: of each stage, about.
    """

    device: torch.device
    seed: int = 0
    width: int = 32
    views: int = 10
    frames: int = 5
    side: int = 24
    sides: tuple[int, int] = (5, 10)
    rays: int = 256
    decoder: int = 32
    iterations: int = 100

    @cached_property
    def data(self) -> ProceduralDataModule:
        """Serves the robot at rest, and seen moving."""
        return ProceduralDataModule(
            shape="robot",
            width=self.width,
            height=self.width * 3 // 4,
            static_views=self.views,
            static_test_views=1,
            train_views=3,
            frames=self.frames,
            supersample=1,
        )

    @cached_property
    def canonical(self) -> LoadedCheckpoint:
        """The robot at rest, learned in PyTorch."""
        stage = self.stage("canonical", PLAIN)
        assert isinstance(stage, CanonicalStage)
        self.learn(stage, PLAIN)
        return stage.result()

    def stage(self, name: str, variant: Variant) -> ScheduledStage:
        """The canonical or the deformation stage, in two levels of resolution."""
        common: dict[str, Any] = {
            "iterations_per_step": 5,
            "graphs": variant.graphs,
            "decoder_precision": variant.precision,
        }
        if name == "canonical":
            schedule = CanonicalSchedule(
                search_iterations=0,
                search_side=max(12, self.side // 2),
                visual_hull_init=True,
                min_views=1,
                iterations=self.iterations,
                side=self.side,
                upsample_at=(self.iterations // 2,),
                decay_iterations=self.iterations,
                rays=self.rays,
            )
            network, sampling = Architecture(width=self.decoder), Sampling(alpha_threshold=3e-3)
            return CanonicalStage(schedule, network, sampling=sampling, **common)
        # The first frame of the first level takes twice as many; the second level's are parallel.
        coarse, fine = self.sides
        first = Level(coarse, max(1, self.iterations * 3 // 4 // self.frames))
        parallel = (self.frames - 1) // 2
        second = Level(fine, max(1, self.iterations // 8), parallel_frames=parallel)
        motion = DeformationSchedule((first, second), rays=self.rays)
        settings = MotionSettings(2e-3, unit="box", views="one", store="host")
        along = {"tracks": StartAlongFlow("flow")}
        rest = copy.deepcopy(self.canonical)
        return DeformationStage(rest, motion, settings, extensions=along, **common)

    def learn(
        self,
        stage: ScheduledStage,
        variant: Variant,
        *callbacks: Callback,
        resumed_from: str | None = None,
    ) -> list[float]:
        """Learn all of ``stage``, from the same random state each time; each step's mean loss."""
        seed_everything(self.seed, verbose=False)
        losses: list[torch.Tensor] = []

        def note(trainer: Any, stage: Any, outputs: Any, batch: Any, number: int) -> None:
            if outputs:
                losses.append(outputs["loss"].detach().clone())  # on the device: nothing waits

        gpu = self.device.type == "cuda"
        curve = LambdaCallback(on_train_batch_end=note)
        trainer = Trainer(
            accelerator="gpu" if gpu else "cpu",
            devices=[self.device.index or 0] if gpu else 1,
            deterministic=variant.deterministic,
            max_epochs=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            callbacks=[GridUpscaling(), LearningRateDecay(), curve, *callbacks],
        )
        trainer.strategy.checkpoint_io = ChecksummedCheckpointIO()
        try:
            with using(variant.kernels):
                trainer.fit(stage, datamodule=self.data, ckpt_path=resumed_from)
            wait(self.device)
        finally:
            torch.use_deterministic_algorithms(False)
        return torch.stack(losses).tolist() if losses else []


def require(condition: bool, said: str) -> None:
    """Fail the check unless ``condition`` holds."""
    if not condition:
        raise DevrfError(said)


def require_gpu(scene: SmallScene, reason: str) -> None:
    """Skip the check unless the device is a GPU."""
    if scene.device.type != "cuda":
        raise CheckSkippedError(f"needs a GPU: {reason}")


def kernel(scene: SmallScene, case: Case) -> str:
    """Whether an operation gives the same in Triton as in PyTorch."""
    if os.environ.get("TRITON_INTERPRET") != "1":
        require_gpu(scene, "or Triton's interpreter, TRITON_INTERPRET=1")
    error, share = compare(case, scene.device)
    require(share <= 1, f"off by {error:.2g}")
    return f"largest error {error:.2g}, {share:.2g} of what is allowed"


def capture(scene: SmallScene, name: str) -> str:
    """Whether every phase of a stage is captured and learned from graphs, along PyTorch's curve."""
    require_gpu(scene, "a CPU has no CUDA graphs")
    expected = scene.learn(scene.stage(name, PLAIN), PLAIN)
    stage = scene.stage(name, FAST)
    before = time.perf_counter()
    losses = scene.learn(stage, FAST)
    speed = stage.iteration / (time.perf_counter() - before)
    count = stage.loop.num_captures
    require(stage.loop.graphs == "auto", "a capture failed")
    require(count >= 2, f"{count} captures, expected one for each resolution")
    require(len(losses) == len(expected), f"{len(losses)} steps, PyTorch took {len(expected)}")
    last = slice(-max(1, len(losses) // 4), None)
    require(mean(losses[last]) < losses[0], "the loss did not fall")
    # The first step before roundings add up, and the last quarter.
    for part, steps, limit in (("first", slice(1), 0.02), ("last", last, 0.05)):
        off = abs(mean(losses[steps]) / mean(expected[steps]) - 1)
        require(off <= limit, f"the {part} losses are {100 * off:.1f} % off PyTorch's")
    return f"{count} captures, {speed:.0f} iterations/s, loss {losses[0]:.4f} to {losses[-1]:.4f}"


def resume(scene: SmallScene, name: str, variant: Variant) -> str:
    """Whether a stage that SIGTERM stops goes on to what it would have come to.

    To equal bits where ``variant`` is deterministic, else to about the same loss: with CUDA graphs
    sums are added in changing order.
    """
    if not variant.deterministic:
        require_gpu(scene, "a CPU has no CUDA graphs")
    whole, first, second = (scene.stage(name, variant) for _ in range(3))
    losses = scene.learn(whole, variant)

    def interrupt(*_: Any) -> None:
        if 0 <= first.iteration - first.total_iterations // 2 < first.iterations_per_step:
            os.kill(os.getpid(), signal.SIGTERM)

    with tempfile.TemporaryDirectory() as folder:
        saving = PeriodicCheckpoint(folder, every_seconds=math.inf)
        with StopOnSignal(saving) as stop:
            sender = LambdaCallback(on_train_batch_start=interrupt)
            scene.learn(first, variant, saving, stop, sender)
        files = progress_files(Path(folder), name)
        stopped = f"stopped at iteration {first.iteration} of {first.total_iterations}"
        interrupted = stop.number is not None and 0 < first.iteration < first.total_iterations
        require(interrupted and bool(files), f"{stopped}, {len(files)} progress files")
        resumed = scene.learn(second, variant, resumed_from=str(files[0]))
    require(second.iteration == whole.iteration, f"ended at iteration {second.iteration}")
    if variant.deterministic:
        pairs = zip(whole.state_dict().values(), second.state_dict().values(), strict=True)
        same = all(torch.equal(a, b) for a, b in pairs if isinstance(a, torch.Tensor))
        require(same, f"{stopped}, came to other fields")
        return f"{stopped}, equal bits"
    off = abs(mean(resumed) / mean(losses[-len(resumed) :]) - 1)
    require(off <= 0.05, f"{stopped}, the loss is {100 * off:.1f} % off")
    return f"{stopped}, the loss {100 * off:.2g} % off"


# Kernels, whether the decoder works in half precision, and grey levels by which a picture may be
# off PyTorch's in the mean: a sample at a threshold may be kept by one implementation alone.
PICTURES: Sequence[tuple[Kind, bool, float]] = (("triton", False, 1e-3), ("triton", True, 5e-3))


def rendering(scene: SmallScene) -> str:
    """Whether every renderer shows what PyTorch shows."""
    require_gpu(scene, "a CPU has one renderer")
    stage = scene.stage("deformation", PLAIN)
    scene.learn(stage, PLAIN)
    model = stage.current_model()
    assert isinstance(model, DeVRFModel)
    model, views = model.to(scene.device), scene.data.scene.dynamic.test
    last, background = len(views) - 1, background_value(scene.data.scene.background)

    def picture(kernels: Kind, half: bool) -> torch.Tensor:
        time, renderer = float(views.times[last]), Renderer(model, half=half)
        with using(kernels):
            return renderer.view(views.cameras, last, time, background).color.float()

    expected, largest = picture("torch", False), 0.0
    for kernels, half, limit in PICTURES:
        off = float((picture(kernels, half) - expected).abs().mean())
        require(off <= limit, f"{kernels}, half={half}: {off:.2g} off PyTorch's picture")
        largest = max(largest, off)
    return f"{largest:.2g} off PyTorch's picture at most"


@contextmanager
def at_most(device: torch.device, more: int) -> Iterator[None]:
    """Within the block torch's allocator may hold ``more`` bytes beside what it holds now."""
    free_cache(device)
    total = torch.cuda.get_device_properties(device).total_memory
    limit = torch.cuda.memory_reserved(device) + more
    torch.cuda.set_per_process_memory_fraction(min(1.0, limit / total), device)
    try:
        yield
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, device)


class ScarceCapture(CudaGraphCapture):
    """Captures; memory is short in the third warm-up, or in the first capture.

    The first warm-up makes gradients and moments, which stay; the second takes a batch alone, and
    is measured. The third has three quarters of that.

    Attributes:
        times_short: how often memory was short.
    """

    def __init__(self, device: torch.device, within: Literal["warm-up", "capture"]) -> None:
        super().__init__(device)
        self._within, self._warm_ups, self._taken = within, 0, 0
        self.times_short = 0

    def warm_up(self, work: Work) -> None:
        """Run ``work``."""
        self._warm_ups += 1
        free_cache(self.device)
        before = torch.cuda.memory_reserved(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        scarce = self._warm_ups == 3 and self._within == "warm-up"
        self.times_short += scarce
        with at_most(self.device, 3 * self._taken // 4) if scarce else nullcontext():
            super().warm_up(work)
        self._taken = torch.cuda.max_memory_reserved(self.device) - before

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        """A graph of ``work``."""
        scarce = not self.times_short and self._within == "capture"
        self.times_short += scarce
        with at_most(self.device, 0) if scarce else nullcontext():
            return super().capture(work)


def short_memory(scene: SmallScene, within: Literal["warm-up", "capture"]) -> str:
    """Whether all is learned when memory runs out: in micro-batches, or without graphs."""
    require_gpu(scene, "its allocator takes a limit")
    stage = scene.stage("canonical", FAST)
    capturer = stage.loop._capture = ScarceCapture(scene.device, within)
    losses = scene.learn(stage, FAST)
    require(capturer.times_short == 1, "memory was never short")
    require(stage.iteration == stage.total_iterations, f"ended at iteration {stage.iteration}")
    require(all(map(math.isfinite, losses)) and min(losses) < losses[0], "the loss did not fall")
    if within == "capture":
        require(stage.loop.graphs == "off", "it was captured all the same")
        return "went on without graphs"
    count = stage.loop.micro_batching.count
    require(count > 1, "batches were not split")
    return f"batches were split into {count} micro-batches"


CHECKS: dict[str, Callable[[SmallScene], str]] = {
    **{
        f"kernel {case.__name__.replace('_', ' ')}": partial(kernel, case=case)
        for cases in CASES.values()
        for case in cases
    },
    "capture canonical": partial(capture, name="canonical"),
    "capture deformation": partial(capture, name="deformation"),
    "resume canonical": partial(resume, name="canonical", variant=EXACT),
    "resume deformation": partial(resume, name="deformation", variant=EXACT),
    "resume canonical graphs": partial(resume, name="canonical", variant=FAST),
    "resume deformation graphs": partial(resume, name="deformation", variant=FAST),
    "rendering": rendering,
    "memory warm-up": partial(short_memory, within="warm-up"),
    "memory capture": partial(short_memory, within="capture"),
}


def small_scene(device: torch.device, seed: int = 0) -> SmallScene:
    """The scene of a size that suits the device."""
    if device.type != "cuda":
        return SmallScene(device, seed)
    return SmallScene(device, seed, 96, 24, 9, 64, (10, 20), rays=4096, decoder=128)


def run_checks(
    device: torch.device, seed: int, only: Sequence[str] | None = None
) -> Iterator[tuple[str, str, str]]:
    """Name, verdict (passed, skipped or failed), and figures or reason of each check.

    Args:
        device: what is checked.
        seed: of what is learned.
        only: first words of the checks to make; None: all.

    Raises:
        DevrfError: no check begins with one of the words of ``only``.
    """
    for start in only or ():
        if not any(name.startswith(start) for name in CHECKS):
            kinds = dict.fromkeys(name.split()[0] for name in CHECKS)
            raise DevrfError(
                f"selfcheck.only: expected the first words of a check ({', '.join(kinds)}), "
                f"not {start!r}{did_you_mean(start, [*kinds, *CHECKS])}"
            )
    scene = small_scene(device, seed)
    for name, check in CHECKS.items():
        if only is None or name.startswith(tuple(only)):
            try:
                yield name, "passed", check(scene)
            except CheckSkippedError as reason:
                yield name, "skipped", str(reason)
            except Exception as error:
                log.debug("%s", name, exc_info=True)
                yield name, "failed", " ".join(f"{type(error).__name__}: {error}".split())

"""Iterations as CUDA graphs: whether they are captured, and what waits for the device."""

from __future__ import annotations

import linecache
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import torch
from lightning import Callback, LightningModule, Trainer

import devrf
from devrf.engine.graphs import CudaGraphCapture, GraphedStep, Work
from devrf.engine.stage import ScheduledStage
from devrf.selfcheck.bench import Bench, Way
from devrf.selfcheck.finding import Finding

PACKAGE = Path(devrf.__file__).parent
# How torch's warning in torch.cuda.set_sync_debug_mode("warn") begins.
WAITS = "called a synchronizing CUDA operation"
# Waits are expected in these functions, which run while the lengths of lists are adapted.
ADAPTING = ("measure",)


class RaisingCapture(CudaGraphCapture):
    """Captures; keeps the error of a capture that failed.

    Attributes:
        errors: with their tracebacks, the first cause first.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.errors: list[str] = []

    def capture(self, work: Work) -> torch.cuda.CUDAGraph:
        """A graph of ``work``."""
        try:
            return super().capture(work)
        except Exception as error:
            self.errors.append("".join(traceback.format_exception(error)))
            raise


def capture(bench: Bench, name: str) -> Finding:
    """Whether every phase of a stage is captured, and learned from graphs to the end."""
    way = Way("triton", "auto")
    stage = bench.build(name, way, bench.below(name))
    capturer = RaisingCapture(bench.device)
    stage.loop._capture = capturer
    torch.cuda.reset_peak_memory_stats(bench.device)
    learned = bench.learn(stage, way)
    for error in capturer.errors:
        print(error)
    allocated = torch.cuda.max_memory_allocated(bench.device) / 2**30
    reserved = torch.cuda.max_memory_reserved(bench.device) / 2**30
    count, phases = stage.loop.num_captures, _bindings(stage)
    figures = {
        "captures": count,
        "expected_at_least": phases,
        "errors": capturer.errors,
        "short_lists": stage.loop.num_short_lists,
        "iterations": stage.iteration,
        "seconds": round(learned.seconds, 3),
        "peak_gpu_gb": round(allocated, 3),
        "peak_reserved_gb": round(reserved, 3),
    }
    said = f"{count} captures, {allocated:.2f} GiB allocated, {reserved:.2f} GiB reserved"
    held = not capturer.errors and stage.loop.graphs == "auto" and count >= phases
    if capturer.errors:
        said += f"; {capturer.errors[0].strip().splitlines()[-1]}"
    elif not held:
        said += f"; at least {phases} captures were expected"
    return Finding(held, said, figures)


def _bindings(stage: ScheduledStage) -> int:
    """How often the stage binds other tensors for long enough to be captured."""
    found, start = set(), 0
    while start < stage.total_iterations:
        phase = stage.phase_at(start)
        if phase.stop - phase.start > GraphedStep.WARM_UP:
            found.add((phase.kind, getattr(phase, "voxels", None)))
        start = phase.stop
    return len(found)


class WatchWaits(Callback):
    """Counts what waits for the device, with the place, from a Lightning step on.

    Attributes:
        places: how often something waited, by ``where`` (``iteration``, ``between``: Lightning's
            hooks and callbacks, or ``adapting``) and the place in the source.
        steps: Lightning steps that were watched.
    """

    def __init__(self, first: int) -> None:
        """Watch from step ``first`` on, so that kernels are compiled and graphs captured."""
        self.places: Counter[tuple[str, str]] = Counter()
        self.steps = 0
        self._first = first
        self._show: Callable[..., None] | None = None

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Begin to watch, if it is time to."""
        if batch_idx == self._first:
            torch.cuda.set_sync_debug_mode("warn")
        self.steps += batch_idx >= self._first

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count torch's warnings within the block; others stay as they are."""
        usual = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if WAITS in str(message):
                self.places[place_of(traceback.extract_stack(), filename, lineno)] += 1
            else:
                usual(message, category, filename, lineno, file, line)

        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = show
            try:
                yield
            finally:
                torch.cuda.set_sync_debug_mode("default")


def place_of(stack: traceback.StackSummary, filename: str, lineno: int) -> tuple[str, str]:
    """Where something waited: in which part of a run, and the innermost line of devrf.

    Args:
        stack: at the warning.
        filename: that the warning was given for, in case devrf is not on the stack.
        lineno: of the same.
    """
    own = [
        frame
        for frame in stack
        if Path(frame.filename).is_relative_to(PACKAGE)
        and not Path(frame.filename).is_relative_to(PACKAGE / "selfcheck")
    ]
    iterates = any(frame.name == "_iterate" for frame in own)
    part = "iteration" if iterates else "between"
    if any(frame.name in ADAPTING for frame in own):
        part = "adapting"
    if not own:
        return part, f"{filename}:{lineno} {linecache.getline(filename, lineno).strip()}"
    last = own[-1]
    return part, f"{Path(last.filename).relative_to(PACKAGE.parent)}:{last.lineno} {last.line}"


def waits(bench: Bench, name: str, way: Way) -> Finding:
    """Whether nothing within an iteration waits for the device, once all is warm.

    Waits between iterations (Lightning, callbacks, a new frame) are counted and located, too.
    """
    below, count = bench.below(name), 3 * bench.size.iterations
    # One resolution, so that nothing is bound anew while waits are counted.
    stage: ScheduledStage
    if name == "canonical":
        stage = bench.canonical(way, iterations=count, doublings=(), decay_iterations=count)
    else:
        assert below is not None
        visits = {"iterations_per_frame": (count // bench.size.frames,)}
        sides = {"sides": bench.size.sides[1:], "parallel_frames": (1,)}
        stage = bench.deformation(below, way, **sides, **visits)
    watch = WatchWaits(first=bench.size.iterations // stage.iterations_per_step)
    with watch.counting():
        bench.learn(stage, way, watch)
    parts = {part: 0 for part in ("iteration", "between", "adapting")}
    for (part, _), number in watch.places.items():
        parts[part] += number
    ranked = [
        {"part": part, "place": place, "count": number}
        for (part, place), number in watch.places.most_common()
    ]
    said = f"{parts['iteration']} waits within iterations, {parts['between']} between"
    said += f", in {watch.steps} steps"
    first = next((one for one in ranked if one["part"] == "iteration"), None)
    if first is not None:
        said += f"; most often {first['place']}"
    return Finding(
        parts["iteration"] == 0 and watch.steps > 0, said, {"steps": watch.steps, "places": ranked}
    )

"""Every check, and which of them a device can do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import torch

from devrf.selfcheck.bench import STAGES, Bench, Way
from devrf.selfcheck.ceilings import ceilings
from devrf.selfcheck.finding import Finding
from devrf.selfcheck.graph_checks import capture, waits
from devrf.selfcheck.kernel_checks import NAMES, kernel
from devrf.selfcheck.learning_checks import WAYS, curve, curve_name, determinism
from devrf.selfcheck.memory_checks import for_good, in_capture, in_warm_up
from devrf.selfcheck.rendering_checks import frames
from devrf.selfcheck.resume_checks import resume
from devrf.system.machine import multiplies_bfloat16

# Figures of the checks so far, by name.
Earlier = Mapping[str, Mapping[str, Any]]
Work = Callable[[Bench, Earlier], Finding]

NO_TRITON = "triton is not installed"
NO_GRAPHS = "needs a GPU: a CPU has no CUDA graphs"


@dataclass(frozen=True)
class Check:
    """A check.

    Attributes:
        name: of a check or its first words are what ``selfcheck.only`` takes.
        work: does it, given what to learn and what was found before.
        gpu: why it says nothing without a GPU; None if it does.
        triton: whether it runs Triton's kernels.
        bfloat16: whether it computes in bfloat16.
    """

    name: str
    work: Work
    gpu: str | None = None
    triton: bool = False
    bfloat16: bool = False

    def left_out(self, device: torch.device) -> str | None:
        """Why ``device`` cannot do the check; None if it can."""
        if self.gpu is not None and device.type != "cuda":
            return self.gpu
        if self.triton and find_spec("triton") is None:
            return NO_TRITON
        if self.bfloat16 and device.type == "cuda" and not multiplies_bfloat16(device):
            return "the GPU multiplies no bfloat16"
        return None


def _kernel(name: str) -> Check:
    return Check(f"kernel {name}", lambda bench, _: kernel(bench, name), triton=True)


def _curve(stage: str, way: Way) -> Check:
    triton = way.kernels == "triton"
    slow = "needs a GPU: Triton's interpreter would take minutes"
    return Check(
        curve_name(stage, way),
        lambda bench, earlier: curve(bench, stage, way, earlier),
        gpu=slow if triton else None,
        triton=triton,
        bfloat16=way.precision == "bfloat16",
    )


def _capture(stage: str) -> Check:
    work: Work = lambda bench, _: capture(bench, stage)  # noqa: E731 - one of many alike
    return Check(f"capture {stage}", work, gpu=NO_GRAPHS, triton=True)


def _waits(stage: str, way: Way) -> Check:
    replayed = "graphs" if way.graphs == "auto" else "eager"
    work: Work = lambda bench, _: waits(bench, stage, way)  # noqa: E731
    reason = "needs a GPU: nothing waits for a CPU"
    return Check(f"waits {stage} {replayed}", work, gpu=reason, triton=True)


def _determinism(stage: str) -> Check:
    return Check(f"determinism {stage}", lambda bench, _: determinism(bench, stage))


def _resume(stage: str) -> Check:
    way = Way("auto", "auto", "auto", deterministic=True)
    return Check(f"resume {stage}", lambda bench, _: resume(bench, stage, way))


def _resume_from_graphs(stage: str) -> Check:
    work: Work = lambda bench, _: resume(bench, stage, Way("triton", "auto"))  # noqa: E731
    return Check(f"resume {stage} graphs", work, gpu=NO_GRAPHS, triton=True)


def _memory(name: str, work: Callable[[Bench], Finding]) -> Check:
    reason = "needs a GPU: its allocator takes a limit"
    return Check(f"memory {name}", lambda bench, _: work(bench), gpu=reason, triton=True)


# What others build on comes first.
CHECKS: tuple[Check, ...] = (
    *map(_kernel, NAMES),
    Check("ceilings", lambda bench, _: ceilings(bench)),
    *map(_capture, STAGES),
    *(_curve(stage, way) for stage in STAGES for way in WAYS),
    *(_waits(stage, Way("triton", graphs)) for stage in STAGES for graphs in ("off", "auto")),
    *map(_determinism, STAGES),
    *map(_resume, STAGES),
    *map(_resume_from_graphs, STAGES),
    _memory("in warm-up", in_warm_up),
    _memory("in capture", in_capture),
    _memory("for good", for_good),
    Check("frames", lambda bench, _: frames(bench)),
)


def check_named(name: str) -> Check:
    """The check of that name."""
    return next(check for check in CHECKS if check.name == name)

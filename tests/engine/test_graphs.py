"""Iterations in lists of fixed length learn what others learn, and are captured when they may be.

The kernels run in Triton's interpreter.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
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
from devrf.system.graphs import CudaGraphCapture, GraphedStep, Work

pytest.importorskip("triton")

LOSS = {"color": 1.0, "per_sample_color": 0.1, "entropy": 0.01}


def canonical(rest: LoadedCheckpoint) -> ScheduledStage:
    """Few rays through a coarse grid, for the interpreter's sake; every kernel has work."""
    small = Architecture(channels=4, width=8, frequencies=1)
    schedule = CanonicalSchedule(0, 5, True, 3, 5, (), decay_iterations=6, rays=5)
    return CanonicalStage(schedule, small, fine_loss={**LOSS, "tv": 1e-3}, iterations_per_step=2)


def moving(rest: LoadedCheckpoint, *levels: Level) -> ScheduledStage:
    rest = copy.deepcopy(rest)
    rest.model.canonical.resize(6**3)
    rest.model.occupancy = Occupancy.full((5, 6, 4), rest.model.canonical.box)
    rest.model.settings = replace(rest.model.settings, step=1.0, alpha_threshold=1e-2)
    schedule = DeformationSchedule(levels or (Level(3, 1),), rays=5)
    motion = MotionSettings(learning_rate=2e-3, views="one", occupancy_every=2)
    return DeformationStage(rest, schedule, motion, iterations_per_step=2)


@pytest.fixture(autouse=True)
def short_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter is slow on padding, too."""
    monkeypatch.setattr(SampleCapacity, "VISIBLE", 32)
    monkeypatch.setattr(SampleCapacity, "GRAIN", 64)


@pytest.mark.parametrize("build", [canonical, moving])
def test_lists_of_fixed_length_teach_what_exact_ones_do(build, rest, trainer, datamodule):
    def learn(kernels: Kind) -> ScheduledStage:
        torch.manual_seed(3)
        stage = build(rest)
        with using(kernels):
            trainer(max_epochs=1).fit(stage, datamodule=datamodule)
        return stage

    static, exact = learn("triton"), learn("torch")
    assert static.optimizer.keeps_gradients and not exact.optimizer.keeps_gradients
    # Sums are in another order, and where a gradient is only rounding, Adam's first steps still
    # have the length of the learning rate.
    for name, value in exact.state_dict().items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            off = (static.state_dict()[name] - value).abs()
            assert off.mean() <= 0.02 * value.abs().mean() + 1e-6, name


class StandIn:
    """A stand-in for what captures graphs; notes what is done."""

    def __init__(self) -> None:
        self.noted: list[str] = []

    def warm_up(self, work: Work) -> None:
        work()

    def capture(self, work: Work) -> Any:
        self.noted.append("captured")
        return SimpleNamespace(replay=work)


def test_before_a_capture_lists_have_been_long_enough_for_every_view(
    rest, trainer, datamodule, monkeypatch
):
    """The views take turns: a list that is measured on one of them may be too short for another."""
    capturer, usual = StandIn(), DeformationStage.draw

    def draw(self: DeformationStage, batch: Any) -> Any:
        capturer.noted.append(f"view {self.iteration % len(self.active[0].pools)}")
        return usual(self, batch)

    # In PyTorch: which view is drawn from has nothing to do with kernels.
    monkeypatch.setattr(GraphedStep, "WARM_UP", 1)
    monkeypatch.setattr(DeformationStage, "static_shape", True)
    monkeypatch.setattr(DeformationStage, "draw", draw)
    monkeypatch.setattr(SampleCapacity, "measure", lambda self: capturer.noted.append("measured"))
    stage = moving(rest, Level(3, 2))
    stage.loop.capturer = lambda: capturer  # type: ignore[assignment,method-assign]
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    first = ["view 0", "view 1", "measured", "view 0", "captured"]
    assert capturer.noted[:6] == [*first, "view 1"] and capturer.noted.count("captured") == 1
    assert stage.loop.num_captures == 1


def test_work_is_captured_after_its_warm_up():
    capturer = StandIn()
    repeated = GraphedStep(lambda: capturer.noted.append("work"), capturer)  # type: ignore[arg-type]
    for call in range(5):
        repeated()
        assert repeated.is_warm == (call == GraphedStep.WARM_UP - 1)
        assert repeated.has_captured == (call == GraphedStep.WARM_UP)
    assert capturer.noted == [*["work"] * 3, "captured", *["work"] * 2]


def test_work_that_cannot_be_captured_is_repeated_with_one_warning(caplog, monkeypatch):
    capturer, calls = StandIn(), []

    def capture(work: Work) -> Any:
        try:
            raise ValueError("a tensor of data's shape\nand more")
        except ValueError:
            raise RuntimeError("the capture was invalidated") from None

    monkeypatch.setattr(capturer, "capture", capture)
    step = GraphedStep(lambda: calls.append(1), capturer)  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING, logger="devrf"):
        for _ in range(GraphedStep.WARM_UP + 3):
            step()
    assert step.failed and len(calls) == GraphedStep.WARM_UP + 3
    (said,) = caplog.messages
    assert said.endswith("(ValueError: a tensor of data's shape)")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_after_a_failed_capture_streams_memory_and_chance_are_as_before():
    device = torch.device("cuda", 0)
    present, values = torch.cuda.current_stream(device), torch.ones(8, device=device)
    step = GraphedStep(lambda: print(values.sum().item()), CudaGraphCapture(device))
    for _ in range(GraphedStep.WARM_UP + 2):
        step()
    assert step.failed and torch.cuda.current_stream(device) == present
    assert torch.ones(8, device=device).sum() == 8 and torch.rand(8, device=device).amax() < 1

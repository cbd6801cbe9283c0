"""The checks of curves, determinism, resuming, kernels and pictures hold, and can fail."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.methods.devrf.voxel_stage import VoxelStage
from devrf.selfcheck import learning_checks, rendering_checks, resume_checks
from devrf.selfcheck.bench import Bench, Way
from devrf.selfcheck.ceilings import ceilings
from devrf.selfcheck.kernel_checks import NAMES, kernel
from devrf.selfcheck.learning_checks import REFERENCE, curve, curve_name, determinism
from devrf.selfcheck.rendering_checks import frames
from devrf.selfcheck.resume_checks import resume

EXACT = Way("auto", "auto", "auto", deterministic=True)


def test_a_curve_is_held_to_that_of_torch(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    # So few iterations take less off the loss.
    monkeypatch.setattr(learning_checks, "FALLEN", 0.92)
    bench.size = replace(bench.size, side=24, rays=256, iterations=50)
    first = curve(bench, "canonical", REFERENCE, {})
    assert first.held, first.said
    losses = first.figures["losses"]
    assert len(losses) == 10 and first.figures["iterations"] == 50
    # What is off by a fifth is found, in the first step already.
    off = {"losses": [loss * 1.2 for loss in losses]}
    other = replace(REFERENCE, precision="bfloat16")
    found = curve(bench, "canonical", other, {curve_name("canonical", REFERENCE): off})
    assert not found.held and "first step 16.7 % off" in found.said
    assert found.figures["losses"] == pytest.approx(losses, rel=0.01)
    # Iterations that change nothing do not learn.
    monkeypatch.setattr(Bench, "canonical", _at_rate_zero(bench.canonical))
    assert curve(bench, "canonical", REFERENCE, {}).said.endswith("the loss did not fall")


def _at_rate_zero(build: Any) -> Any:
    def built(self: Bench, way: Way, **other: Any) -> Any:
        stage = build(way, **other)
        stage.learning_rate_factor = lambda iteration: 0.0
        return stage

    return built


def test_losses_that_are_not_finite_fail() -> None:
    faults = learning_checks._faults([0.5, float("nan")], float("nan"))
    assert faults == ["not every loss is finite"]
    differences = learning_checks._differences
    assert differences([1.0], [1.0, 0.5]) == ["1 steps, PyTorch took 2"]
    assert differences([1.0], None) == ["there is no curve of PyTorch to compare with"]
    assert differences([2.0, 1.0], [2.0, 1.04]) == []
    assert differences([2.0, 1.0], [2.0, 0.9]) == ["last quarter 11.1 % off PyTorch's curve"]
    (said,) = differences([float("nan"), 1.0], [2.0, 1.0])
    assert said.startswith("first step nan")


def test_determinism_holds_and_a_difference_is_found(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert determinism(bench, "canonical").said == "equal bits twice"
    usual, calls = Bench.set_random_state, iter(range(9))
    monkeypatch.setattr(
        Bench, "set_random_state", lambda self: (usual(self), torch.manual_seed(next(calls)))
    )
    found = determinism(bench, "canonical")
    assert not found.held and found.said == "two runs differ"
    assert not torch.are_deterministic_algorithms_enabled()


@pytest.mark.parametrize("name", ["canonical", "deformation"])
def test_a_signal_stops_a_stage_that_goes_on_to_equal_bits(bench: Bench, name: str) -> None:
    found = resume(bench, name, EXACT)
    assert found.held and found.said.endswith("equal bits"), found.said
    assert 0 < found.figures["stopped_at"] < 20


def test_a_stage_that_goes_on_otherwise_is_noticed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = VoxelStage._reseed

    def other(self: VoxelStage) -> None:
        usual(self)
        if self.trainer.ckpt_path:
            self.generator.manual_seed(5)

    monkeypatch.setattr(VoxelStage, "_reseed", other)
    found = resume(bench, "canonical", EXACT)
    assert not found.held and "equal bits" not in found.said


def test_a_signal_that_stops_nothing_is_noticed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resume_checks.os, "kill", lambda pid, number: None)
    found = resume(bench, "canonical", EXACT)
    assert not found.held and "at iteration 20 of 20" in found.said


def test_a_kernel_agrees_in_the_interpreter(bench: Bench) -> None:
    pytest.importorskip("triton")
    found = kernel(bench, NAMES[NAMES.index("compositing")])
    assert found.held and found.figures["interpreted"]
    assert found.figures["max_error"] < 1e-5 and found.figures["compile_seconds"] is None


def test_frames_are_counted_and_pictures_compared(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = frames(bench)
    assert found.held and found.figures["torch"]["pixels"] == [24, 18]
    assert found.figures["torch"]["off"] == 0 and found.figures["torch"]["new_time"] > 0
    usual, calls = rendering_checks._picture, iter(range(2))
    monkeypatch.setattr(
        rendering_checks, "_picture", lambda *a, **k: usual(*a, **k) + next(calls) / 100
    )
    found = frames(bench)
    assert not found.held and "torch: 0.01 off PyTorch's picture" in found.said


def test_ceilings_are_measured(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("devrf.selfcheck.ceilings.ON_CPU_SIDE", 64)
    monkeypatch.setattr("devrf.selfcheck.ceilings.ON_CPU_BYTES", 2**16)
    found = ceilings(bench)
    assert found.held and found.figures["precision"] == "float32"
    assert found.figures["operations_per_second"] > 1e6

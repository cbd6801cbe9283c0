"""Micro-batches learn what whole batches learn; too little memory for any ends the stage."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch

from devrf.callbacks import PeriodicCheckpoint
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import Pixels
from devrf.engine.micro_batching import MicroBatching
from devrf.engine.stage import ScheduledStage
from devrf.errors import DevrfError
from devrf.methods.devrf import volume_rendering as rendering
from devrf.methods.devrf import voxel_stage
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage

SMALL = Architecture(channels=4, width=8, frequencies=1)
SCHEDULE = CanonicalSchedule(0, 12, True, 4, 12, (), rays=64)
MOVING = DeformationSchedule(levels=(Level(4, 4),), rays=64)
# Without the terms that are means over what rays have met.
BY_RAY = {"render": 1.0, "per_sample_color": 0.1, "entropy": 0.01}


@pytest.fixture
def memory_for(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], list[int]]:
    """``memory_for(rays, from_call)``: more rays at once fail from a call on; the rays of each."""

    def limit(rays: int, from_call: int = 0) -> list[int]:
        calls: list[int] = []

        def render(some: Any, *others: Any) -> Any:
            calls.append(len(some))
            if len(calls) > from_call and len(some) > rays:
                raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB.")
            return rendering.render(some, *others)

        monkeypatch.setattr(voxel_stage, "render", render)
        return calls

    return limit


@pytest.fixture
def learn(fit: Callable[..., ScheduledStage]) -> Callable[..., ScheduledStage]:
    """Like ``fit``, from the same random numbers each time."""

    def seeded(*stage_and_callbacks: Any, **how: Any) -> ScheduledStage:
        torch.manual_seed(2)
        return fit(*stage_and_callbacks, **how)

    return seeded


def canonical() -> CanonicalStage:
    return CanonicalStage(SCHEDULE, SMALL, iterations_per_step=2)


def moving(rest: LoadedCheckpoint) -> DeformationStage:
    return DeformationStage(copy.deepcopy(rest), MOVING, loss=BY_RAY)


def assert_alike(one: ScheduledStage, other: ScheduledStage) -> None:
    """Equal up to rounding, which Adam's first steps amplify."""
    for name, value in one.state_dict().items():
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            torch.testing.assert_close(value, other.state_dict()[name], rtol=1e-3, atol=1e-4)


def test_the_canonical_stage_learns_the_same_in_parts(learn, memory_for, caplog):
    whole = learn(canonical())
    calls = memory_for(8)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        divided = learn(canonical())
    assert divided.loop.micro_batching.count == 8
    assert calls[:5] == [64, 32, 16, 8, 8] and calls[-8:] == [8] * 8
    assert_alike(divided, whole)
    said = [line for line in caplog.messages if "out of memory (2.5 GiB more asked" in line]
    assert ["2 micro" in said[0], "4 micro" in said[1], "8 micro" in said[2]] == [True] * 3


def test_memory_that_runs_out_in_a_visit_changes_nothing(learn, memory_for, rest):
    whole = learn(moving(rest))
    # Three frames: frame 1 in iterations 0 to 7; in the last of these the batch does not fit.
    calls = memory_for(32, from_call=7)
    divided = learn(moving(rest))
    assert divided.loop.micro_batching.count == 2
    assert calls == [64] * 8 + [32] * 2 * 5
    assert_alike(divided, whole)


def test_a_frame_that_never_fits_ends_the_stage_saved(learn, memory_for, rest, tmp_path):
    calls = memory_for(4, from_call=9)
    stage = moving(rest)
    with pytest.raises(DevrfError, match=r"at iteration 9 of 12 \(frame 2, ") as caught:
        learn(stage, PeriodicCheckpoint(tmp_path, every_seconds=1000))
    assert "schedule.deformation.levels.1.side" in str(caught.value)
    assert calls[9:] == [64, 32, 16, 8]
    gradients = [p.grad for group in stage.optimizer.param_groups for p in group["params"]]
    assert gradients == [None] * 2 and stage.iteration == 9
    assert [path.name for path in tmp_path.iterdir()] == ["deformation-progress-9.ckpt"]


def test_memory_that_runs_out_in_the_backward_pass_changes_nothing(learn, monkeypatch):
    whole, failing = learn(canonical()), canonical()
    usual, calls = failing.manual_backward, [0]

    def backward(loss: torch.Tensor) -> None:
        calls[0] += 1
        usual(loss)
        if calls[0] == 3:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(failing, "manual_backward", backward)
    learn(failing)
    assert failing.loop.micro_batching.count == 2
    assert_alike(failing, whole)


def test_the_number_of_micro_batches_is_resumed(learn, memory_for, tmp_path):
    memory_for(32)
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    learn(canonical(), saving)
    calls = memory_for(64)
    again = canonical()
    learn(again, ckpt_path=tmp_path / "canonical-progress-2.ckpt")
    assert again.loop.micro_batching.count == 2 and set(calls) == {32}


def test_one_of_several_processes_ends_with_an_error(monkeypatch):
    monkeypatch.setattr("devrf.engine.micro_batching.world_size", lambda: 2)

    def loss(pixels: Pixels) -> Any:
        raise MemoryError

    pixels = Pixels(torch.zeros(8), torch.zeros(8), torch.ones(3))
    with pytest.raises(DevrfError, match="one of 2 processes is out of memory"):
        MicroBatching().gradients(loss, pixels, lambda total: None, lambda: None)


def test_micro_batches_are_the_batch_in_order(rng):
    pixels = Pixels(
        torch.randint(6, (7,), generator=rng), torch.arange(7) * 5, torch.rand(7, 3, generator=rng)
    )
    parts, seen = MicroBatching(), []
    parts.count = 3

    def loss(part: Pixels) -> Any:
        seen.append(part)
        return torch.ones(()), {"rays": torch.tensor(float(len(part)))}

    total, terms = parts.gradients(loss, pixels, lambda total: None, lambda: None)
    assert total == pytest.approx(1.0)
    assert terms["rays"] == pytest.approx((2 * 2 + 2 * 2 + 3 * 3) / 7)
    for name in ("image", "flat", "background"):
        assert torch.equal(torch.cat([getattr(p, name) for p in seen]), getattr(pixels, name))

"""What every stage does: means over iterations; half a batch when memory runs out, once."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import Any

import pytest
import torch
from lightning import Callback

from devrf.callbacks import PeriodicCheckpoint
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.engine.schedule import scale_schedule, unscaled
from devrf.engine.stage import Stage, mean_terms
from devrf.errors import DevrfError
from devrf.methods.devrf import canonical_stage, deformation_stage
from devrf.methods.devrf import volume_rendering as rendering
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage

SMALL = Architecture(channels=4, width=8, frequencies=1)
SCHEDULE = CanonicalSchedule(0, 12, True, 4, 12, (), rays=64)
MOVING = DeformationSchedule(levels=(Level(4, 4),), rays=64)


@pytest.fixture
def memory_for(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], list[int]]:
    """``memory_for(rays, from_call)``: more rays at once fail from a call on; the rays of each."""

    def limit(rays: int, from_call: int = 0) -> list[int]:
        calls: list[int] = []

        def render(some: Any, *others: Any, **named: Any) -> Any:
            calls.append(len(some))
            if len(calls) > from_call and len(some) > rays:
                raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB.")
            return rendering.render(some, *others, **named)

        monkeypatch.setattr(canonical_stage, "render", render)
        monkeypatch.setattr(deformation_stage, "render", render)
        return calls

    return limit


def canonical() -> CanonicalStage:
    return CanonicalStage(SCHEDULE, SMALL, iterations_per_step=2)


def moving(rest: LoadedCheckpoint) -> DeformationStage:
    return DeformationStage(copy.deepcopy(rest), MOVING)


def gradients(stage: Stage) -> list[torch.Tensor | None]:
    return [p.grad for group in stage.optimizer.param_groups for p in group["params"]]


def test_means_over_iterations() -> None:
    terms = [
        {"render": torch.tensor(factor), "loss": torch.tensor(2 * factor)} for factor in (1.0, 3.0)
    ]
    means = mean_terms(terms, processes=1)
    assert {name: float(mean) for name, mean in means.items()} == {"render": 2.0, "loss": 4.0}
    assert float(terms[0]["loss"]) == 2.0
    assert mean_terms([], processes=1) == {}


def test_each_of_several_processes_draws_its_share():
    stage = canonical()
    stage.batch_size.processes = 4
    assert [stage.batch_size.rays(64), stage.batch_size.rays(64, most=40)] == [16, 10]
    stage.batch_size.share = 0.5
    assert [stage.batch_size.rays(64), stage.batch_size.rays(1)] == [8, 1]


def test_when_memory_runs_out_batches_are_halved(fit, memory_for, caplog):
    calls = memory_for(32)
    with caplog.at_level(logging.WARNING, logger="devrf"):
        stage = fit(canonical())
    assert stage.batch_size.share == 0.5 and stage.position.iterations_done == 4
    assert calls == [64, 32, 32, 32, 32]
    (said,) = caplog.messages
    assert "out of memory (2.5 GiB more asked" in said and said.endswith("from now on")


def test_memory_that_runs_out_in_the_backward_pass_leaves_no_gradient(fit, monkeypatch):
    stage = canonical()
    usual, before = stage.manual_backward, []

    def backward(loss: torch.Tensor) -> None:
        before.append(all(grad is None or not grad.any() for grad in gradients(stage)))
        usual(loss)
        if len(before) == 3:
            raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr(stage, "manual_backward", backward)
    fit(stage)
    assert before == [True] * 5 and stage.batch_size.share == 0.5


def test_a_frame_that_does_not_fit_in_half_either_ends_the_stage_saved(
    fit, memory_for, rest, tmp_path
):
    calls = memory_for(16, from_call=9)
    stage = moving(rest)
    with pytest.raises(DevrfError, match=r"at iteration 9 of 12 \(frame 2, ") as caught:
        fit(stage, PeriodicCheckpoint(tmp_path, every_seconds=1000))
    assert "schedule.deformation.levels.1.side" in str(caught.value)
    assert calls[9:] == [64, 32]
    assert gradients(stage) == [None] * 2 and stage.position.iteration == 9
    assert [path.name for path in tmp_path.iterdir()] == ["deformation-progress-9.ckpt"]


def test_a_resumed_stage_draws_half_batches_too(fit, memory_for, tmp_path):
    memory_for(32)
    saving = PeriodicCheckpoint(tmp_path, every_seconds=0, share=1.0)
    fit(canonical(), saving)
    calls = memory_for(64)
    again = canonical()
    fit(again, ckpt_path=tmp_path / "canonical-progress-2.ckpt")
    assert again.batch_size.share == 0.5 and set(calls) == {32}


def test_one_of_several_processes_ends_with_an_error(fit, memory_for):
    class OneOfTwo(CanonicalStage):
        def setup(self, stage: str) -> None:
            super().setup(stage)
            self.batch_size.processes = 2

    memory_for(0)
    with pytest.raises(DevrfError, match="one of 2 processes is out of memory"):
        fit(OneOfTwo(SCHEDULE, SMALL, iterations_per_step=2))


def test_what_is_due_comes_at_multiples_after_its_start(fit):
    found = []

    class Watched(CanonicalStage):
        def opaque(self) -> torch.Tensor:
            found.append(self.position.iteration)
            return super().opaque()

    schedule = CanonicalSchedule(0, 12, True, 30, 12, (), rays=16, occupancy_every=8)
    fit(Watched(schedule, SMALL, iterations_per_step=5))
    assert found == [4, 12, 20, 28, 30]


def test_a_scaled_schedule_goes_on_at_the_same_place(fit):
    """In half its iterations from iteration 6 of 12 on: 3 are over, 3 are left; grids as before."""
    schedule = CanonicalSchedule(0, 12, True, 12, 12, (4, 8), rays=16)
    seen = []

    class Scale(Callback):
        def on_train_batch_end(self, trainer: Any, stage: Any, *_: Any) -> None:
            if stage.position.iteration == 6 and stage.position.schedule_scale == 1:
                scale_schedule(stage, 0.5)
                assert stage.position.iteration == 3
            seen.append(stage.scene_model.resolution)

    stage = fit(CanonicalStage(schedule, SMALL, iterations_per_step=1), Scale())
    assert stage.position.iterations_done == 6 + 3 and stage.schedule.total == 6
    assert unscaled(stage).total == 12 and stage.is_complete
    assert seen == sorted(seen) and len(set(seen)) == 3

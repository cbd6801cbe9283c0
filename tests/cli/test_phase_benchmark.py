"""A stage taken through some of its phases, each of them timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import pytest
import torch
from lightning import Trainer
from lightning.pytorch import seed_everything

from devrf.callbacks import LearningRateDecay, PhaseBenchmark
from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.schedules import CanonicalSchedule, DeformationSchedule
from devrf.system.profiling import OVERHEAD, Part, measured

SCHEDULE = CanonicalSchedule(
    search_iterations=0,
    search_side=12,
    carve=True,
    iterations=40,
    side=16,
    doublings=(10, 25),
    rays=128,
)
MOTION = DeformationSchedule(sides=(4, 6), iterations_per_frame=(4, 3), rays=128)


@pytest.fixture
def excerpt(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> Callable[[ScheduledStage, PhaseBenchmark], Trainer]:
    """Takes a stage through excerpts, without ``GridUpscaling``."""

    def fit(stage: ScheduledStage, excerpts: PhaseBenchmark) -> Trainer:
        seed_everything(0, verbose=False)
        fitted = Trainer(
            accelerator="cpu",
            devices=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            max_epochs=1,
            callbacks=[excerpts, LearningRateDecay()],
        )
        fitted.fit(stage, datamodule=datamodule)
        return fitted

    return fit


def test_the_rest_state_at_every_resolution(
    rest: LoadedCheckpoint, excerpt: Callable[[ScheduledStage, PhaseBenchmark], Trainer]
) -> None:
    before = {
        name: tensor.clone()
        for name, tensor in rest.model.state_dict().items()
        if isinstance(tensor, torch.Tensor)
    }
    stage = CanonicalStage(SCHEDULE, iterations_per_step=5)
    excerpts = PhaseBenchmark([30, 0], 1, 2, rest.model)
    fitted = excerpt(stage, excerpts)
    box = rest.model.canonical.box
    fine, coarse = excerpts.timings
    assert fine.resolution == box.grid_shape(16**3)
    assert coarse.resolution == box.grid_shape(16**3 // 4)
    # One step to warm up, two of either kind, in both phases.
    assert fitted.global_step == 2 * 5 * 5 and fine.iterations == 5
    for timing in excerpts.timings:
        assert (timing.stage, timing.phase, timing.frames) == ("canonical", "fine", ())
        assert set(timing.parts) == {*get_args(Part), OVERHEAD} - {"warp"}
        assert 0 < timing.seconds.low <= timing.seconds.median <= timing.seconds.high
        parts = sum(spread.median for spread in timing.parts.values())
        assert parts == pytest.approx(timing.measured_seconds.median, rel=1e-6)
        assert timing.counts["tested"] >= timing.counts["heavy"] > 0 and timing.rays == 128
        assert timing.work is not None and timing.allocated is None
    assert not measured()
    # The fields that it started from are as they were.
    after = rest.model.state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())


def test_a_moving_scene_at_every_level(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    excerpt: Callable[[ScheduledStage, PhaseBenchmark], Trainer],
) -> None:
    learned = DeformationStage(rest, MOTION)
    trainer(max_epochs=1).fit(learned, datamodule=datamodule)
    moved = learned.field.to_canonical.clone()
    stage = DeformationStage(LoadedCheckpoint(rest.metadata, rest.model), MOTION)
    excerpts = PhaseBenchmark([15, 4], 0, 1, learned.model)
    excerpt(stage, excerpts)
    box = rest.model.canonical.box
    assert [(t.phase, t.frames, t.resolution) for t in excerpts.timings] == [
        ("level 1", (1,), box.grid_shape(6**3)),
        ("level 0", (1,), box.grid_shape(4**3)),
    ]
    assert set(excerpts.timings[0].parts) == {*get_args(Part), OVERHEAD}
    # A visit shorter than a step of ten iterations is measured as it is.
    assert [timing.iterations for timing in excerpts.timings] == [6, 8]
    assert torch.equal(learned.field.to_canonical, moved)


def test_frames_that_are_visited_together(
    rest: LoadedCheckpoint, four_frames: SceneDataModule, trainer: Callable[..., Trainer]
) -> None:
    schedule = replace(MOTION, coarse_to_fine=False, parallel_frames=(1, 2))
    stage, excerpts = DeformationStage(rest, schedule), PhaseBenchmark([0, 7], 0, 1, None)
    fitted = trainer(max_epochs=1)
    fitted.callbacks = [excerpts, LearningRateDecay()]  # type: ignore[attr-defined]
    fitted.fit(stage, datamodule=four_frames)
    assert [(t.frames, t.rays) for t in excerpts.timings] == [((2,), 128), ((1, 3), 256)]
    for timing in excerpts.timings:
        assert set(timing.parts) == {*get_args(Part), OVERHEAD}


def test_a_search_starts_where_searches_start(
    excerpt: Callable[[ScheduledStage, PhaseBenchmark], Trainer],
) -> None:
    schedule = CanonicalSchedule(
        search_iterations=6, search_side=8, iterations=4, side=8, doublings=(), rays=64
    )
    stage, excerpts = (
        CanonicalStage(schedule, iterations_per_step=4),
        PhaseBenchmark([0], 0, 3, None),
    )
    excerpt(stage, excerpts)
    (timing,) = excerpts.timings
    assert timing.phase == "search" and timing.iterations == 4
    # It is sent back rather than into the next phase.
    assert stage.iteration == 4 and stage.model.canonical.color.values.shape[-1] == 3

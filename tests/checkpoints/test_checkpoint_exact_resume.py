"""A stage that is left and taken up again comes to the same numbers, to the last bit."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import LambdaCallback

from devrf.checkpoints.checkpoint import (
    LoadedCheckpoint,
    load_checkpoint,
)
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.data.datamodule import SceneDataModule
from devrf.engine.schedule import phases
from devrf.engine.stage import Stage
from devrf.errors import DevrfError
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level, Visits
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extension import Extension
from devrf.methods.devrf.extensions.color_residual import LearnColorResidual
from devrf.methods.devrf.extensions.frame_start import StartFromBest
from devrf.methods.devrf.extensions.priors import Elastic
from devrf.methods.devrf.extensions.tracks import StartAlongFlow
from devrf.methods.devrf.settings import VisitSettings

SMALL = Architecture(channels=4, width=8, frequencies=1, search_alpha_init=1e-2)
# Search 0–7, then fine 8–19 with upsample_at after 4 and 8 of its iterations.
SEARCHING = CanonicalSchedule(
    search_iterations=8,
    search_side=12,
    visual_hull_init=True,
    iterations=12,
    side=14,
    upsample_at=(4, 8),
    decay_iterations=6,
    occupancy_every=5,
    rays=64,
)
# Three frames. Level 0: frame 1 in 0–11, frame 2 in 12–17; level 1: 18–25 and 26–29.
MOVING = DeformationSchedule(levels=(Level(4, 6), Level(6, 4)), rays=64)
# The occupancy is looked up anew in iterations 3, 6, 9 of a visit; frames start along tracks.
OFTEN = VisitSettings(2e-3, unit="box", views="all", pixels="occupied", occupancy_every=3)
# Then once more: 30–35 and 36–38.
AGAIN = replace(MOVING, levels=(*MOVING.levels, Level(6, 3)))


PRIORS = {"render": 1.0, "cycle": 100.0, "tv": 1.0, "elastic": 0.1}
# The field would not keep exactly what a visit has learned.
ROUNDED = VisitSettings(occupancy_every=3, store="host", store_half=True)


def leave(path: Path, iteration: int) -> Callback:
    """Leaves the run after an iteration, with a file to go on from."""

    def act(trainer: Trainer, stage: Any, *_: Any) -> None:
        if stage.position.iteration == iteration:
            trainer.save_checkpoint(path)
            trainer.should_stop = True

    return LambdaCallback(on_train_batch_end=act)


def canonical() -> Stage:
    return CanonicalStage(SEARCHING, SMALL, iterations_per_step=1)


def everything(stage: Stage) -> dict[str, Any]:
    """All that was learned, with the optimiser's state and the next random numbers."""
    return {
        "fields": copy.deepcopy(stage.state_dict()),
        "optimizer": copy.deepcopy(stage.optimizer.state_dict()),
        "metadata": stage.result().metadata,
        "iteration": stage.position.iteration,
        "next": [torch.rand(4), np.random.rand(2).tolist(), random.random()],
    }


def assert_same(one: Any, other: Any, where: str = "") -> None:
    assert type(one) is type(other), where
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other), where
    elif isinstance(one, dict):
        assert list(one) == list(other), where
        for key in one:
            assert_same(one[key], other[key], f"{where}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}/{k}")
    else:
        assert one == other, where


def begin_at(seed: int) -> None:
    """Set every generator that anything may draw from."""
    torch.manual_seed(seed)
    np.random.seed(seed)
    random.seed(seed)


@pytest.fixture
def learn(
    datamodule: SceneDataModule, trainer: Callable[..., Trainer], tmp_path: Path
) -> Callable[..., dict[str, Any]]:
    """Learn, leaving after each of some iterations and going on with a new stage each time."""

    def run(
        build: Callable[[], Stage], *leaves: int, data: SceneDataModule = datamodule
    ) -> dict[str, Any]:
        begin_at(3)
        left: str | None = None
        for at in [*leaves, None]:
            stage, path = build(), tmp_path / f"{at}.ckpt"
            fit = trainer(*([] if at is None else [leave(path, at)]), max_epochs=1)
            fit.fit(stage, datamodule=data, ckpt_path=left)
            if at is not None:
                assert stage.position.iteration == at
                # Another process would draw other numbers if it were not told where to go on.
                left = str(path)
                begin_at(99)
        return everything(stage)

    return run


def test_the_canonical_stage_goes_on_exactly(learn):
    # In the search, at its end, before the occupancy is renewed, at an upsampling, at last.
    leaves = (1, 8, 10, 12, 19)
    assert_same(learn(canonical, *leaves), learn(canonical))


def deformation(
    rest: LoadedCheckpoint, *arguments: Any, each: int = 1, **extensions: Extension
) -> Callable[[], Stage]:
    """Makes a deformation stage of ``each`` iterations a step."""
    return lambda: DeformationStage(
        copy.deepcopy(rest), *arguments, iterations_per_step=each, extensions=extensions
    )


@pytest.mark.parametrize(
    ("each", "leaves"),
    [
        # Mid-frame, at a look at the occupancy, at a frame's end, a level's, at last.
        (1, (2, 3, 12, 18, 29)),
        (4, (4, 26)),
    ],
)
def test_the_deformation_stage_goes_on_exactly(learn, rest, each, leaves):
    build = deformation(rest, MOVING, OFTEN, each=each, tracks=StartAlongFlow("tracks"))
    assert_same(learn(build, *leaves), learn(build))


@pytest.mark.parametrize("scored", [False, True])
def test_a_fit_that_ended_by_its_steps_goes_on_exactly(
    learn, rest, datamodule, trainer, tmp_path, scored
):
    build, path = deformation(rest, MOVING, ROUNDED), tmp_path / "left.ckpt"
    begin_at(3)
    first, second = trainer(max_steps=5), trainer(max_epochs=1)
    stage = build()
    first.fit(stage, datamodule=datamodule)
    if scored:
        first.test(stage, datamodule=datamodule, verbose=False)
    first.save_checkpoint(path)  # mid-visit, after the frame was let go
    begin_at(99)
    stage = build()
    second.fit(stage, datamodule=datamodule, ckpt_path=str(path))
    assert_same(everything(stage), learn(build))


def test_starts_from_the_best_and_a_level_backwards_go_on_exactly(learn, rest):
    rows = (Level(4, 6), Level(6, 4, backwards=True), Level(6, 3))
    schedule = replace(MOVING, levels=rows)
    assert [phase.frame for phase in phases(Visits(schedule, 3))] == [1, 2, 2, 1, 1, 2]
    starts = {"frame_start": StartFromBest(levels=3, rays=32)}
    build = deformation(rest, schedule, OFTEN, **starts)
    # At a frame's end, mid-visit, at the end of a level, at the end of the first frame backwards.
    assert_same(learn(build, 12, 14, 18, 26, 31), learn(build))


def test_colours_that_change_go_on_exactly(learn, rest):
    colors = LearnColorResidual("always", side=5, start_level=2)
    build = deformation(rest, MOVING, ROUNDED, color_residual=colors)
    # Mid-visit at both levels, at a frame's end.
    whole = learn(build)
    assert_same(learn(build, 3, 20, 26), whole)
    assert len(whole["optimizer"]["param_groups"][1]["params"]) == 1


def test_a_second_sweep_with_the_elastic_prior_goes_on_exactly(learn, rest):
    build = deformation(rest, AGAIN, ROUNDED, PRIORS, elastic=Elastic())
    # At a look at the occupancy, at the end of a level, mid-visit.
    whole = learn(build)
    assert_same(learn(build, 21, 30, 34), whole)


def test_only_what_is_to_be_gone_on_from_holds_the_way_there(
    datamodule, trainer, tmp_path, tiny_scene
):
    stage, path = canonical(), tmp_path / "left.ckpt"
    fit = trainer(leave(path, 10), max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    fit.save_checkpoint(tmp_path / "shown.ckpt", weights_only=True)
    assert read_checkpoint_file(path)["progress"]["iteration"] == 10
    assert "progress" not in read_checkpoint_file(tmp_path / "shown.ckpt")
    # What is left half-way can be looked at all the same.
    assert not load_checkpoint(path, tiny_scene).metadata.complete


def test_another_schedule_is_refused(datamodule, trainer, tmp_path):
    path, longer = tmp_path / "left.ckpt", CanonicalStage(replace(SEARCHING, iterations=13), SMALL)
    trainer(leave(path, 2), max_epochs=1).fit(canonical(), datamodule=datamodule)
    fit = trainer(max_epochs=1)
    with pytest.raises(DevrfError, match=f"^{path}.*a schedule of 20 iterations, .* one of 21"):
        fit.fit(longer, datamodule=datamodule, ckpt_path=str(path))


def test_a_file_of_an_earlier_version_is_refused(datamodule, trainer, tmp_path):
    path = tmp_path / "left.ckpt"
    trainer(leave(path, 2), max_epochs=1).fit(canonical(), datamodule=datamodule)
    content = read_checkpoint_file(path)
    del content["progress"]["batch_share"]
    write_checkpoint_file(path, content)
    fit = trainer(max_epochs=1)
    with pytest.raises(DevrfError, match=rf"^{path}: .*batch_share: Field required.*resume=false"):
        fit.fit(canonical(), datamodule=datamodule, ckpt_path=str(path))

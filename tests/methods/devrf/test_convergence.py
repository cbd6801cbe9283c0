"""A frame that has nothing left to gain is left early."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
from lightning import Trainer

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.methods.devrf.convergence import converged
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings

SCHEDULE = DeformationSchedule(sides=(4, 6), iterations_per_frame=(12, 8), rays=64)


@pytest.mark.parametrize(
    ("losses", "done"),
    [
        ([1.0], False),
        ([1.0, 1.0], False),  # too few to tell
        ([1.0, 0.99, 0.985], True),
        ([1.0, 0.99, 0.9], False),  # the last has gained a tenth
        ([1.0, 0.9, 1.2], False),  # dear pixels, but the one before has gained
        ([1.0, 0.5, 0.51, 0.505], True),
    ],
)
def test_by_hand(losses: list[float], done: bool) -> None:
    assert converged(losses, min_rel_improvement=0.02) is done


@pytest.fixture
def learn(
    rest: LoadedCheckpoint, datamodule: SceneDataModule, trainer: Callable[..., Trainer]
) -> Callable[[float | None], DeformationStage]:
    def run(gain: float | None) -> DeformationStage:
        stage = DeformationStage(
            copy.deepcopy(rest),
            SCHEDULE,
            MotionSettings(min_rel_improvement=gain),
            iterations_per_step=2,
        )
        trainer(max_epochs=1).fit(stage, datamodule=datamodule)
        return stage

    return run


def test_a_frame_that_has_converged_is_left(learn: Callable[..., DeformationStage]) -> None:
    # No step takes off all of the loss: each visit ends after the three steps that tell.
    hasty = learn(1.0)
    visits = 2 * 2
    assert hasty.iteration - hasty.skipped == visits * 3 * 2
    assert hasty.iteration == hasty.total_iterations == 60


def test_nothing_is_left_out_unless_asked(learn: Callable[..., DeformationStage]) -> None:
    assert learn(None).skipped == 0


def test_a_gain_is_a_share() -> None:
    with pytest.raises(DevrfError, match="schedule.motion.min_rel_improvement: expected above 0"):
        MotionSettings(min_rel_improvement=0.0)

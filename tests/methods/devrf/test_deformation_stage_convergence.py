"""A frame that has nothing left to gain is left early."""

from __future__ import annotations

import pytest

from devrf.errors import DevrfError
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level, converged
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import VisitSettings

SCHEDULE = DeformationSchedule(levels=(Level(4, 12), Level(6, 8)), rays=64)


@pytest.mark.parametrize(
    ("losses", "done"),
    [
        ([1.0, 1.0], False),  # too few to tell
        ([1.0, 0.99, 0.985], True),
        ([1.0, 0.99, 0.9], False),  # the last has gained a tenth
        ([1.0, 0.9, 1.2], False),  # dear pixels, but the one before has gained
    ],
)
def test_by_hand(losses, done):
    assert converged(losses, min_rel_improvement=0.02) is done


def test_a_frame_that_has_converged_is_left_if_asked(rest, datamodule, trainer):
    visit = VisitSettings(min_rel_improvement=1.0)
    stage = DeformationStage(rest, SCHEDULE, visit, iterations_per_step=2)
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    # No step takes off all of the loss: each visit ends after the three steps that tell.
    assert stage.position.iterations_done == 2 * 2 * 3 * 2
    assert stage.position.iteration == stage.schedule.total == 60


def test_a_gain_is_a_share():
    with pytest.raises(DevrfError, match="schedule.visit.min_rel_improvement"):
        VisitSettings(min_rel_improvement=0.0)

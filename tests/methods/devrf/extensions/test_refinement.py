"""The canonical field learns on from static and dynamic views, through warps that are final."""

from __future__ import annotations

import copy

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.extensions.refinement import RefinementSchedule, RefinementStage
from devrf.methods.devrf.settings import CanonicalRates, MotionSettings
from devrf.rendering.renderer import Renderer

SHORT = DeformationSchedule(levels=(Level(4, 6), Level(6, 3)), rays=128)
FAST = MotionSettings(learning_rate=5e-3, views="all", pixels="occupied")
REFINED = RefinementSchedule(15, rays=128, rates=CanonicalRates(0.05, 0.05, 5e-4), grow=1)


def test_the_rates_fall_over_the_stage(rest):
    stage = RefinementStage(copy.deepcopy(rest), RefinementSchedule(12, decay=0.01))
    rates = [stage.learning_rate_factor(n) for n in (0, 11, 500)]
    assert rates == pytest.approx([1.0, 0.01, 0.01])


def test_the_field_learns_and_the_motion_stays(rest, datamodule, tiny_scene, trainer):
    moving = DeformationStage(rest, SHORT, FAST)
    trainer(max_epochs=1).fit(moving, datamodule=datamodule)
    plain = copy.deepcopy(moving.scene_model)
    stage = RefinementStage(
        LoadedCheckpoint(moving.metadata(), moving.scene_model), REFINED, pixels="occupied"
    )
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    refined = stage.scene_model
    assert stage.iteration == 15 and stage.metadata().complete
    for name in ("to_canonical", "to_time"):
        before, after = (getattr(model.deformation, name) for model in (plain, refined))
        assert torch.equal(before, after)
    assert not torch.equal(plain.canonical.density.values, refined.canonical.density.values)
    assert (refined.occupancy.mask | plain.occupancy.mask).equal(refined.occupancy.mask)
    train = tiny_scene.dynamic.train
    worse, better = (
        sum(score(Renderer(model), train, k, "white").psnr for k in range(6))
        for model in (plain, refined)
    )
    assert better > worse


def test_wrong_settings_are_told():
    with pytest.raises(DevrfError, match="refinement.schedule"):
        RefinementSchedule(static_share=1.0)

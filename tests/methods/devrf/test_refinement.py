"""The canonical field learns on from static and dynamic views, through warps that are final."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.evaluation.held_out import score
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.refinement import RefinementPhase, RefinementSettings
from devrf.methods.devrf.settings import CanonicalRates, MotionSettings
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

SHORT = DeformationSchedule(levels=(Level(4, 8), Level(6, 4)), rays=256)
FAST = MotionSettings(learning_rate=5e-3, views="all", pixels="occupied")
# Three frames: 24 + 12 iterations, then these.
REFINED = RefinementSettings(iterations=30, rates=CanonicalRates(0.05, 0.05, 5e-4), grow=1)


def test_the_rates_fall_over_the_phase() -> None:
    phase = RefinementPhase(start=100, stop=111, decay=0.01)
    rates = [phase.learning_rate_factor(n) for n in (100, 105, 110, 500)]
    assert rates == pytest.approx([1.0, 0.1, 0.01, 0.01])


def test_the_field_learns_and_the_motion_stays(
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    tiny_scene: Scene,
    trainer: Callable[..., Trainer],
) -> None:
    given = {k: v.clone() for k, v in rest.model.state_dict().items() if torch.is_tensor(v)}
    seen = []
    for settings in (replace(REFINED, iterations=0), REFINED):
        torch.manual_seed(0)
        stage = DeformationStage(rest, SHORT, FAST, refinement=settings)
        trainer(max_epochs=1).fit(stage, datamodule=datamodule)
        assert stage.iteration == 36 + settings.iterations
        seen.append(stage.scene_model)
    plain, refined = seen
    for name in ("to_canonical", "to_time"):
        frames = (getattr(model.deformation, name) for model in seen)
        assert torch.equal(*frames)
    assert not torch.equal(plain.canonical.density.values, refined.canonical.density.values)
    # What was given is as it was.
    for name, value in rest.model.state_dict().items():
        if torch.is_tensor(value):
            assert torch.equal(value, given[name])
    assert (refined.occupancy.mask | plain.occupancy.mask).equal(refined.occupancy.mask)
    train = tiny_scene.dynamic.train
    before, after = (
        sum(score(Renderer(model), train, k, "white").psnr for k in range(6)) for model in seen
    )
    assert after > before


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"iterations": -1}, "schedule.refinement.iterations: expected 0 or more, not -1"),
        ({"grow": -2}, "schedule.refinement.grow: expected 0 or more"),
        ({"static_share": 1.0}, "schedule.refinement.static_share: expected above 0, below 1"),
        ({"decay": 0.0}, "schedule.refinement.decay: expected above 0, at most 1"),
    ],
)
def test_wrong_settings_are_told(wrong: dict[str, float], told: str) -> None:
    with pytest.raises(DevrfError, match=told):
        RefinementSettings(**wrong)  # type: ignore[arg-type]

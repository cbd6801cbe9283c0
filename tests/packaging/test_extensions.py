"""Each extension can be taken out, with its block of the config: the rest composes and learns."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
from hydra.utils import instantiate
from lightning import Trainer
from omegaconf import DictConfig

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.cli.config_check import check_config
from devrf.data.datamodule import SceneDataModule
from devrf.methods.devrf.deformation_stage import DeformationStage

EXTENSIONS = "devrf.methods.devrf.extensions"
QUICK = [f"schedule.deformation.levels.{number}.iterations=1" for number in (1, 2, 3)]


@pytest.mark.parametrize(
    ("file", "removed"),
    [
        ("color_residual", ["~schedule.extensions.color_residual"]),
        ("tracks", ["~schedule.extensions.tracks"]),
        ("frame_start", ["~schedule.extensions.frame_start"]),
        ("priors", ["~schedule.extensions.elastic", "~schedule.extensions.bending"]),
    ],
)
def test_without_it_the_motion_is_learned(
    file: str,
    removed: list[str],
    composed: Callable[..., DictConfig],
    rest: LoadedCheckpoint,
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, f"{EXTENSIONS}.{file}", None)  # importing it fails
    config = composed("data=procedural", *removed, *QUICK, "schedule.deformation.rays=64")
    check_config(config)
    stage = instantiate(config.deformation, _partial_=True, _convert_="all")(earlier=rest)
    assert isinstance(stage, DeformationStage)
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    assert stage.position.iteration == stage.schedule.total
    assert bool(stage.field.forward_slices.any())

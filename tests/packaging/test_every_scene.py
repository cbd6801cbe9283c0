"""Both stages learn from scenes on disk, and configs of published scenes are complete."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.scenes.export import export
from devrf.scenes.scene import Scene

PUBLISHED_INWARD = ["lego", "floating_robot", "daisy", "glove", "kuka", "flower_360"]
PUBLISHED_FORWARD = ["plant", "rabbit", "pig_toy"]
TINY = [
    "field.width=8",
    "field.channels=4",
    "video=default",
    "schedule.canonical.search_iterations=0",
    "schedule.canonical.search_side=12",
    "schedule.canonical.iterations=2",
    "schedule.canonical.side=12",
    "schedule.canonical.upsample_at=[]",
    "schedule.canonical.rays=128",
    "schedule.deformation.levels.1={side:4,iterations:2}",
    "schedule.deformation.levels.2=null",
    "schedule.deformation.levels.3=null",
    "schedule.deformation.rays=128",
    "canonical.iterations_per_step=1",
    "deformation.iterations_per_step=1",
    "trainer=cpu",
]


@pytest.mark.parametrize("name", ["inward", "forward"])
def test_both_stages_take_two_steps(
    name: str,
    composed: Callable[..., Any],
    trainer: Callable[..., Any],
    tmp_path: Path,
    tiny_scene: Scene,
    tiny_toy: Scene,
) -> None:
    export(tiny_scene if name == "inward" else tiny_toy, tmp_path / "scene")
    facing = ["field.planes=8"] if name == "forward" else []
    config = composed(f"data={name}", f"data.root={tmp_path}/scene", *facing, *TINY)
    module = instantiate(config.data)
    canonical = instantiate(config.canonical, _convert_="all")
    trainer(max_steps=2).fit(canonical, datamodule=module)
    assert canonical.position.iteration == 2
    assert canonical.scene_model.canonical.color.values.abs().max() > 0
    build = instantiate(config.deformation, _partial_=True, _convert_="all")
    deformation: DeformationStage = build(canonical.result())
    trainer(max_steps=2).fit(deformation, datamodule=module)
    assert deformation.position.iteration == 2
    assert module.scene.dynamic.train.flow is not None
    assert torch.isfinite(deformation.field.backward_slices).all()


@pytest.mark.parametrize("name", PUBLISHED_INWARD + PUBLISHED_FORWARD)
def test_a_published_scene_leaves_only_its_folder_to_give(
    composed: Callable[..., Any], name: str
) -> None:
    data = composed(f"data={name}").data
    assert [key for key in data if OmegaConf.is_missing(data, key)] == ["root"]
    forward = name in PUBLISHED_FORWARD
    assert data.name == name and data.background == "white"
    assert data.downscale == (4 if forward else 2)
    assert ("Forward" in data["_target_"]) is forward

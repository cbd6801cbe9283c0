"""Checkpoints: whole, bit-equal, and honest about what they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import load_checkpoint, save_checkpoint
from devrf.checkpoints.checkpoint_file import read_checkpoint_file, write_checkpoint_file
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import DeVRFModel
from devrf.metrics.image import psnr
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene


@pytest.fixture
def canonical(learned: tuple[CanonicalStage, Trainer], tmp_path: Path) -> Path:
    """A checkpoint of the canonical stage."""
    path = tmp_path / "run" / "canonical.ckpt"
    save_checkpoint(learned[1], path)
    return path


def assert_alike(one: DeVRFModel, other: DeVRFModel, scene: Scene) -> None:
    """Pictures differ by what half precision loses: 0.05 dB of one that is at 40 dB."""
    cameras = scene.dynamic.test.cameras
    shape = (cameras.height, cameras.width, 3)
    for time in (0.0, 0.3, 0.5, 1.0):
        a, b = (Renderer(model).view(cameras, 0, time, 1.0) for model in (one, other))
        assert psnr(a.color.view(shape), b.color.view(shape)) > 60, f"at {time}"
        torch.testing.assert_close(a.opacity, b.opacity, atol=0.01, rtol=0)


def refusal(path: Path, scene: Scene | None = None) -> str:
    """The message of the error that loading ``path`` raises: one line that names the file."""
    with pytest.raises(DevrfError) as caught:
        load_checkpoint(path, scene)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The same file with other content, well sealed."""
    data = read_checkpoint_file(path)
    change(data)
    write_checkpoint_file(path, data)
    return path


def test_the_canonical_stage_comes_back(canonical, learned, tiny_scene):
    stored = load_checkpoint(canonical, tiny_scene)
    assert_alike(stored.model, learned[0].scene_model, tiny_scene)
    assert stored.metadata == learned[0].metadata()
    assert stored.model.deformation is None
    assert [p.name for p in canonical.parent.iterdir()] == ["canonical.ckpt"]


def test_the_deformation_stage_comes_back_and_alone_suffices(
    rest, datamodule, tiny_scene, tmp_path, trainer
):
    schedule = DeformationSchedule(levels=(Level(4, 4), Level(6, 2)), rays=128)
    stage, fit = DeformationStage(rest, schedule), trainer(max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    save_checkpoint(fit, tmp_path / "deformation.ckpt")
    stored = load_checkpoint(tmp_path / "deformation.ckpt", tiny_scene)
    assert_alike(stored.model, stage.scene_model, tiny_scene)
    assert stored.model.deformation is not None
    assert stored.model.deformation.clock == tiny_scene.clock
    assert set(stored.metadata.records) == {"canonical", "deformation"}
    # It moves: otherwise equal pictures would say nothing of the deformation.
    renderer, cameras = Renderer(stored.model), tiny_scene.dynamic.test.cameras
    still, moved = (renderer.view(cameras, 0, time, 0.0).color for time in (0.0, 1.0))
    assert not torch.equal(moved, still)


def test_another_scene_is_refused(canonical, tiny_scene):
    views = tiny_scene.static.train
    fewer = replace(views[torch.arange(7)])
    other = replace(tiny_scene, name="cat", static=replace(tiny_scene.static, train=fewer))
    message = refusal(canonical, other)
    assert "another scene" in message and "robot" in message and "cat" in message
    assert load_checkpoint(canonical, None).metadata.scene == "robot"


def test_checkpoints_of_others_are_refused(tmp_path):
    path = tmp_path / "foreign.ckpt"
    assert "no such checkpoint" in refusal(path)
    write_checkpoint_file(path, {"devrf": "yes", "state_dict": {}})
    assert "not a devrf checkpoint" in refusal(path)


MASK, SIZES = "scene_model.occupancy.mask", "scene_model.canonical._extra_state"
CONTRADICTIONS: dict[str, Callable[[dict[str, Any]], object]] = {
    "no scene": lambda data: data["devrf"].pop("scene"),
    "other size": lambda data: data["devrf"]["model"]["architecture"].update(channels=5),
    "text for mask": lambda data: data["state_dict"].update({MASK: "all"}),
    "no box": lambda data: data["state_dict"][SIZES].update(low=[9, 9, 9]),
}


@pytest.mark.parametrize("change", CONTRADICTIONS.values(), ids=list(CONTRADICTIONS))
def test_a_checkpoint_that_contradicts_itself_is_refused(canonical, change):
    refusal(edit(canonical, change))


def test_a_file_may_not_choose_which_code_is_run(canonical):
    path = edit(canonical, lambda data: data["devrf"]["model"].update(_target_="os.system"))
    assert "which is not known here" in refusal(path)

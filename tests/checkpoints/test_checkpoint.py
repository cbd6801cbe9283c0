"""Checkpoints: whole, bit-equal, and honest about what they are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import load_checkpoint
from devrf.checkpoints.checkpoint_file import (
    _digest,
    _header,
    read_checkpoint_file,
    write_checkpoint_file,
)
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule, Level
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.dnerf.model import DNeRFSettings
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.metrics.image import psnr
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene, both_mapped
from devrf.system.memory import own_memory


@pytest.fixture
def canonical(learned: tuple[CanonicalStage, Trainer], tmp_path: Path) -> Path:
    """A checkpoint of the canonical stage."""
    path = tmp_path / "run" / "canonical.ckpt"
    learned[1].save_checkpoint(path, weights_only=True)
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
    assert stored.metadata == learned[0].result().metadata
    assert stored.model.deformation is None
    # Lightning warns of parts of a stage that do not learn.
    assert not stored.model.training and all(m.training for m in DeformationStage(stored).modules())
    assert [p.name for p in canonical.parent.iterdir()] == ["canonical.ckpt"]


def test_the_deformation_stage_comes_back_and_alone_suffices(
    rest, datamodule, tiny_scene, tmp_path, trainer
):
    schedule = DeformationSchedule(levels=(Level(4, 4), Level(6, 2)), rays=128)
    stage, fit = DeformationStage(rest, schedule), trainer(max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    fit.save_checkpoint(tmp_path / "deformation.ckpt", weights_only=True)
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
    # Lightning gives a name: ModelCheckpoint.best_model_path.
    assert load_checkpoint(str(canonical), None).metadata.scene == "robot"


def test_another_scene_by_the_same_cameras_is_refused(canonical, tiny_scene):
    def darker(share):
        def change(views):
            return replace(views, pixels=(views.pixels * share).to(torch.uint8))

        static, dynamic = both_mapped(tiny_scene.static, tiny_scene.dynamic, change)
        return replace(tiny_scene, name="cat", static=static, dynamic=dynamic)

    assert darker(0.5).fingerprint == tiny_scene.fingerprint
    assert "another scene" in refusal(canonical, darker(0.5))
    load_checkpoint(canonical, darker(0.98))  # the same, read a little differently


def test_checkpoints_of_others_are_refused(tmp_path):
    path = tmp_path / "foreign.ckpt"
    assert "no such checkpoint" in refusal(path)
    write_checkpoint_file(path, {"devrf": "yes", "state_dict": {}})
    assert "not a devrf checkpoint" in refusal(path)


MASK, SIZES = "scene_model.occupancy.mask", "scene_model.canonical._extra_state"
COLOR = "scene_model.canonical.color.values"
CONTRADICTIONS: dict[str, Callable[[dict[str, Any]], object]] = {
    "no scene": lambda data: data["devrf"].pop("scene"),
    "other size": lambda data: data["devrf"]["model"]["architecture"].update(channels=5),
    "text for mask": lambda data: data["state_dict"].update({MASK: "all"}),
    "no box": lambda data: data["state_dict"][SIZES].update(low=[9, 9, 9]),
    "no number of voxels": lambda data: data["state_dict"][SIZES].update(base_voxels=0),
    "text for a threshold": lambda data: data["devrf"]["model"]["settings"].update(
        alpha_threshold="x"
    ),
    "no class of a field": lambda data: data["devrf"]["model"].update(color_residual=0),
    "a mask of other rank": lambda data: data["state_dict"].update({MASK: torch.ones(2, 2) > 0}),
    "colours of one point": lambda data: data["state_dict"].update({COLOR: torch.ones(1, 1, 1, 4)}),
    "an offset of two": lambda data: data["viewpoints"].update(offset=(1.0, 2.0)),
    "an offset without end": lambda data: data["viewpoints"].update(offset=(math.inf, 0.0, 0.0)),
    "cameras of double precision": lambda data: data["viewpoints"]["held_out"].update(
        focal=torch.ones(1, 2).double()
    ),
}


@pytest.mark.parametrize("change", CONTRADICTIONS.values(), ids=list(CONTRADICTIONS))
def test_a_checkpoint_that_contradicts_itself_is_refused(canonical, change):
    refusal(edit(canonical, change))


def test_the_offset_of_the_world_comes_back(canonical):
    assert load_checkpoint(canonical).viewpoints.offset == (0, 0, 0)
    far = (500_000.0, 5_600_000.0, 200.0)
    edit(canonical, lambda data: data["viewpoints"].update(offset=far))
    assert load_checkpoint(canonical).viewpoints.offset == far
    edit(canonical, lambda data: data["viewpoints"].pop("offset"))  # an earlier version's
    assert load_checkpoint(canonical).viewpoints.offset == (0, 0, 0)


GRID = "scene_model.canonical.density.values"


def of_frames(data: dict[str, Any]) -> None:
    """Says that all of 2^20 frames have the few bits of one."""
    data["state_dict"][GRID].update(elsewhere=torch.zeros(2**20, 1).half(), shape=[8, 2**17, 1])


def of_nothing(data: dict[str, Any]) -> None:
    """Says that a grid has 10^8 frames of no values."""
    none = torch.zeros(10**8, 0).half()
    data["state_dict"][GRID].update(elsewhere=none, kept=none[:0])


def of_masks(data: dict[str, Any]) -> None:
    """Says that a grid has many masks, of which the first alone is whole."""
    grid = data["state_dict"][GRID]
    short = [torch.zeros(1, dtype=torch.uint8)] * 300
    grid.update(keep=[*grid["keep"], *short], elsewhere=torch.zeros(301, 1).half())


HUGE: dict[str, Callable[[dict[str, Any]], object]] = {
    "wide layers": lambda data: data["devrf"]["model"]["architecture"].update(width=2**14),
    "too many units": lambda data: data["devrf"]["model"]["architecture"].update(width=10**9),
    "octaves": lambda data: data["devrf"]["model"]["architecture"].update(frequencies=16000),
    "fine steps": lambda data: data["devrf"]["model"]["settings"].update(step=1e-9),
    "steps that are no number": lambda data: data["devrf"]["model"]["settings"].update(
        step=math.nan
    ),
    "a grid of many voxels": lambda data: data["state_dict"][GRID].update(shape=[10**4] * 3),
    "many frames": of_frames,
    "frames without values": of_nothing,
    "masks without bits": of_masks,
    "a large image": lambda data: data["viewpoints"]["held_out"].update(width=10**6, height=10**6),
    "a scene that is no name": lambda data: data["devrf"].update(scene=["robot"]),
    "records that are none": lambda data: data["devrf"].update(records=[1]),
}


@pytest.mark.parametrize("change", HUGE.values(), ids=list(HUGE))
def test_a_small_file_does_not_fill_memory(canonical, change):
    before = own_memory()
    refusal(edit(canonical, change))
    assert own_memory() - before < 200e6


def test_grids_that_memory_cannot_hold_are_refused_before_they_are_unpacked(canonical, monkeypatch):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10_000_000))

    def longer(data: dict[str, Any]) -> None:
        keep = torch.zeros(1, 2**21, dtype=torch.uint8)  # 2 MB of bits: 64 MB of numbers
        data["state_dict"][GRID].update(shape=[2**24, 1, 1], keep=keep)

    assert "would take 0.15 GB of memory, and 0.01 GB are free" in refusal(edit(canonical, longer))


@pytest.mark.parametrize(
    "settings",
    [
        lambda: DNeRFSettings(bands=15000),
        lambda: DNeRFSettings(steps=10**6),
        lambda: NeuralVolumesSettings(template_channels=(1,) * 9),
    ],
)
def test_networks_whose_samples_fill_memory_are_refused(settings):
    with pytest.raises(DevrfError, match=r"^ray_stage\.model\.settings\."):
        settings()


def test_damage_that_has_the_right_checksum_is_one_line(tmp_path):
    path = tmp_path / "deep.ckpt"
    for nested in (
        "[" * 10**6,
        '{"dict": [[{"dict": []}, 1]]}',
        '{"tensor": [1]}',
        '{"set": [2305843009213693951, 4611686018427387902]}',
        '{"x": 1, "y": 2}',
    ):
        path.write_bytes(_header(nested, {}, _digest(nested, {})))
        assert "damaged" in refusal(path)


@pytest.mark.parametrize(
    "path",
    [
        *("os.system", "torch.nn.Linear", "devrf.methods.devrf.model.partial", ""),
        "devrf.methods." + "a." * 10_000 + "b",
    ],
    ids=["system", "Linear", "partial", "nothing", "deep"],
)
def test_a_file_names_no_class_but_one_that_is_stored(canonical, path):
    change = edit(canonical, lambda data: data["devrf"]["model"].update({"class": path}))
    assert f"was learned by {path[:200]!r}, which is not known here" in refusal(change)

"""HyperNeRF's facts: Nerfies, and slices of a space of more dimensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import (
    load_checkpoint,
    save_checkpoint,
)
from devrf.data.datamodule import SceneDataModule
from devrf.engine.batches import gather_batch
from devrf.errors import DevrfError
from devrf.methods.hypernerf.model import HyperNeRF, HyperNeRFSettings
from devrf.methods.nerfies.model import Nerfies, NerfiesSettings
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = HyperNeRFSettings(
    width=8, depth=3, bands=2, direction_bands=1, sampling="occupancy", separate_coarse=False,
    steps=16, occupancy_side=8, code=3, warp_width=8, warp_depth=2, warp_bands=2, slicing_width=8,
    slicing_depth=2, slicing_bands=2, ambient_delay=0.0, ambient_window=0.25,
)  # fmt: skip
QUICK = RaySchedule(
    iterations=4, rays=32, learning_rate=1e-2, final_learning_rate=1e-3, iterations_per_step=2
)
LOSS = {"color": 1.0}
JOINT = ProtocolStage("joint", "both")
STATIC = ProtocolStage("canonical", "static")
MOTION = ProtocolStage("deformation", "dynamic", frozen=("canonical",), builds_on="canonical")
Trainers = Callable[..., Trainer]
Slicing = Literal["surface", "plane"]
EITHER = pytest.mark.parametrize("slicing", ["surface", "plane"])


def fit(one: RayStage, trainer: Trainers, data: SceneDataModule) -> Trainer:
    """Train a stage to its end."""
    fitted = trainer(max_epochs=1)
    fitted.fit(one, datamodule=data)
    return fitted


@EITHER
def test_with_ambient_space_shut_it_is_nerfies(slicing: Slicing, tiny_scene: Scene) -> None:
    hyper = HyperNeRF(replace(TINY, slicing=slicing))
    shared = {one.name: getattr(TINY, one.name) for one in fields(NerfiesSettings)}
    plain = Nerfies(NerfiesSettings(**shared))
    hyper.setup(tiny_scene)
    plain.setup(tiny_scene)
    if slicing == "surface":
        torch.nn.init.normal_(hyper.slicing.output.weight)
    state = hyper.state_dict()
    plain.load_state_dict({name: state[name] for name in plain.state_dict()})
    views = tiny_scene.dynamic.train
    image = torch.arange(len(views)).repeat_interleave(30)
    batch = gather_batch(views, image, torch.arange(len(image)) % 400, torch.ones(3))
    for model in (hyper, plain):
        model.eval()
    torch.testing.assert_close(hyper(batch).color, plain(batch).color, atol=1e-6, rtol=1e-6)
    hyper.opened.fill_(1)
    assert (hyper(batch).color - plain(batch).color).abs().max() > 1e-4


def test_ambient_space_opens_after_a_delay() -> None:
    model = HyperNeRF(replace(TINY, ambient_delay=0.25, ambient_window=0.5))
    opened = []
    for step in (0, 25, 50, 75, 100):
        model.on_iteration(step, 100)
        opened.append(model.opened.item())
    assert opened == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_a_plane_has_one_ambient_coordinate_a_frame_and_a_surface_one_a_point() -> None:
    points, time = torch.rand(6, 3), torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    for slicing, same in (("plane", True), ("surface", False)):
        model = HyperNeRF(replace(TINY, slicing=slicing))
        model.opened.fill_(1)
        if slicing == "surface":
            torch.nn.init.normal_(model.slicing.output.weight)
        _, ambient = model.deform(points, time)
        assert ambient is not None and ambient.shape == (6, 4)
        assert torch.equal(ambient[0], ambient[1]) is same
        assert not torch.equal(ambient[0], ambient[3])


@EITHER
@pytest.mark.parametrize("frozen", ["canonical", "canonical*"])
def test_two_stages_freeze_all_or_all_but_what_ambient_space_enters_by(
    frozen: str,
    slicing: Slicing,
    trainer: Trainers,
    datamodule: SceneDataModule,
    tmp_path: Path,
    tiny_scene: Scene,
) -> None:
    settings, path = replace(TINY, slicing=slicing), tmp_path / "canonical.ckpt"
    first = RayStage(HyperNeRF(settings), QUICK, LOSS, STATIC)
    save_checkpoint(fit(first, trainer, datamodule), path)
    assert first.scene_model.opened.item() == 0
    rest = load_checkpoint(path, tiny_scene)
    assert isinstance(rest.model, HyperNeRF)
    before = {k: v.clone() for k, v in rest.model.state_dict().items()}
    cameras = tiny_scene.dynamic.test.cameras
    seen = Renderer(rest.model).view(cameras, 1, 0.0, 1.0).color
    step = replace(MOTION, frozen=(frozen,))
    second = RayStage(HyperNeRF(settings), QUICK, LOSS, step, rest=rest)
    fit(second, trainer, datamodule)
    after = second.scene_model.state_dict()
    changed = {k for k in before if not torch.equal(before[k], after[k])}
    columns = {k for k in before if k.startswith("canonical.trunk.beside.")}
    assert {k for k in changed if k.startswith("canonical.")} == (
        columns if frozen == "canonical" else set()
    )
    assert {"warp.velocity.bias", "codes.table.weight"} <= changed
    assert torch.equal(Renderer(second.scene_model).view(cameras, 1, 0.0, 1.0).color, seen)


@EITHER
def test_a_killed_run_goes_on_to_the_same_weights(
    slicing: Slicing, assert_goes_on_exactly: Callable[[Callable[[], RayStage]], None]
) -> None:
    def stage() -> RayStage:
        torch.manual_seed(0)
        model = HyperNeRF(replace(TINY, slicing=slicing))
        return RayStage(model, QUICK, {"color": 1.0, "elastic": 0.01}, JOINT)

    assert_goes_on_exactly(stage)


def test_dynamic_never_reads_the_static_set(
    assert_never_reads_the_static_set: Callable[[Callable[[], RayStage]], None],
) -> None:
    def stage() -> RayStage:
        torch.manual_seed(0)
        return RayStage(HyperNeRF(TINY), QUICK, LOSS, ProtocolStage("dynamic", "dynamic"))

    assert_never_reads_the_static_set(stage)


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(DevrfError, match="ambient: expected at least 1, not 0; method=nerfies"):
        replace(TINY, ambient=0)
    with pytest.raises(DevrfError, match=r"of at most 1 together, not 0\.5 and 0\.75"):
        replace(TINY, ambient_delay=0.5, ambient_window=0.75)

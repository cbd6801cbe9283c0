"""Nerfies' facts, and that it learns by every protocol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from lightning import Trainer

from devrf.checkpoints.checkpoint import load_checkpoint, save_checkpoint
from devrf.data.batch import RayBatch
from devrf.data.datamodule import SceneDataModule
from devrf.engine.batches import gather_batch
from devrf.errors import DevrfError
from devrf.methods.nerfies.model import Nerfies, NerfiesSettings
from devrf.methods.protocol import ProtocolStage
from devrf.methods.ray_stage import RaySchedule, RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Scene

TINY = NerfiesSettings(
    width=8, depth=3, bands=2, direction_bands=1, sampling="occupancy", separate_coarse=False,
    steps=16, occupancy_side=8, coarse=8, fine=8, code=3, warp_width=8, warp_depth=3, warp_bands=4,
    warp_skip=2,
)  # fmt: skip
QUICK = RaySchedule(
    iterations=4, rays=32, learning_rate=1e-2, final_learning_rate=1e-3, iterations_per_step=2
)
JOINT = ProtocolStage("joint", "both")
STATIC = ProtocolStage("canonical", "static")
MOTION = ProtocolStage("deformation", "dynamic", frozen=("canonical",), builds_on="canonical")
Trainers = Callable[..., Trainer]


def stage(step: ProtocolStage, settings: NerfiesSettings = TINY, **options: object) -> RayStage:
    """A stage of a few iterations on tiny networks."""
    torch.manual_seed(0)
    given = {"schedule": QUICK, "loss": {"color": 1.0, "elastic": 0.1}, "step": step, **options}
    return RayStage(Nerfies(settings), **given)  # type: ignore[arg-type]


def fit(one: RayStage, trainer: Trainers, data: SceneDataModule) -> Trainer:
    """Train a stage to its end."""
    fitted = trainer(max_epochs=1)
    fitted.fit(one, datamodule=data)
    return fitted


def test_the_warp_opens_over_its_share_of_a_stage() -> None:
    model = Nerfies(replace(TINY, window=0.5))
    opened = []
    for step in (0, 25, 50, 100):
        model.on_iteration(step, 100)
        opened.append(model.warp.opened.item())
    assert opened == [0.0, 2.0, 4.0, 4.0]


def test_motions_begin_next_to_none_at_any_time() -> None:
    model, points = Nerfies(TINY), torch.rand(9, 3)
    moved, beside = model.deform(points, torch.linspace(0, 1, 9))
    assert beside is None
    assert 0 < (moved - points).abs().max() < 1e-2


def some_rays(scene: Scene) -> RayBatch:
    """Rays through the pixels of both moving frames of two views."""
    views = scene.dynamic.train
    image = torch.arange(len(views)).repeat_interleave(40)
    flat = torch.arange(len(image)) % (views.width * views.height)
    return gather_batch(views, image, flat, torch.ones(3))


@pytest.mark.parametrize("elastic", ["drawn", "full"])
@pytest.mark.parametrize("separate", [True, False])
def test_a_warp_that_stretches_is_punished_and_one_that_turns_is_not(
    elastic: Literal["drawn", "full"], separate: bool, tiny_scene: Scene
) -> None:
    model = Nerfies(
        replace(TINY, elastic=elastic, sampling="hierarchical", separate_coarse=separate)
    )
    model.setup(tiny_scene)
    batch = some_rays(tiny_scene)
    model.warp.opened.fill_(4)
    for head in (model.warp.rotation, model.warp.velocity):
        torch.nn.init.zeros_(head.weight)
    model.warp.rotation.bias.data = torch.tensor([1.0, -0.5, 2.0])  # one turn of all there is
    turned = model.loss_terms(model(batch), batch, ["elastic"])["elastic"]
    assert turned.item() < 1e-6
    torch.nn.init.normal_(model.warp.velocity.weight)
    stretched = model.loss_terms(model(batch), batch, ["elastic"])["elastic"]
    # c ρ is at most 2 c = 0.06, and the weights of a ray come to at most 1.
    assert 1e-3 < stretched.item() < 0.06


def test_coarse_samples_have_a_field_of_their_own_that_learns(
    trainer: Trainers, datamodule: SceneDataModule
) -> None:
    one = stage(JOINT, replace(TINY, sampling="hierarchical", separate_coarse=True))
    before = one.scene_model.coarse.color.weight.detach().clone()
    fit(one, trainer, datamodule)
    assert not torch.equal(one.scene_model.coarse.color.weight, before)


def test_two_stages_leave_the_canonical_part_and_the_scene_at_rest_as_they_are(
    trainer: Trainers, datamodule: SceneDataModule, tmp_path: Path, tiny_scene: Scene
) -> None:
    first, path = stage(STATIC), tmp_path / "canonical.ckpt"
    warp = {k: v.clone() for k, v in first.scene_model.warp.state_dict().items() if k != "opened"}
    save_checkpoint(fit(first, trainer, datamodule), path)
    assert all(torch.equal(first.scene_model.warp.state_dict()[k], warp[k]) for k in warp)
    rest = load_checkpoint(path, tiny_scene)
    before = {k: v.clone() for k, v in rest.model.canonical.state_dict().items()}
    cameras = tiny_scene.dynamic.test.cameras
    seen = [Renderer(rest.model).view(cameras, 1, time, 1.0).color for time in (0.0, 0.7)]
    second = stage(MOTION, rest=rest)
    fit(second, trainer, datamodule)
    after = second.scene_model.canonical.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before)
    now = [Renderer(second.scene_model).view(cameras, 1, t, 1.0).color for t in (0.0, 0.7)]
    assert torch.equal(now[0], seen[0]) and not torch.equal(now[1], seen[1])


def test_jointly_the_warp_is_free_at_time_zero(
    trainer: Trainers, datamodule: SceneDataModule
) -> None:
    one = stage(JOINT)
    fit(one, trainer, datamodule)
    points = torch.rand(5, 3)
    assert not torch.equal(one.scene_model.deform(points, torch.zeros(5))[0], points)


def test_dynamic_never_reads_the_static_set(
    assert_never_reads_the_static_set: Callable[[Callable[[], RayStage]], None],
) -> None:
    assert_never_reads_the_static_set(lambda: stage(ProtocolStage("dynamic", "dynamic")))


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(DevrfError, match="separate_coarse: sampling=occupancy has no coarse"):
        replace(TINY, separate_coarse=True)
    with pytest.raises(DevrfError, match=r"window: expected a share from 0 to 1, not 1\.5"):
        replace(TINY, window=1.5)

"""How a method is learned from whole images: which are drawn, and rows that come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from devrf.checkpoints.stored_grids import StoredShape
from devrf.data.batch import ImageBatch
from devrf.engine.protocol import Protocol, ProtocolStage
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.space import WORLD
from devrf.methods.base import ImageTrainable
from devrf.methods.image_stage import WHOLE, ImagePlan, ImageStage
from devrf.methods.ray_schedule import RaySchedule
from devrf.rendering.output import RenderedImage, RenderOutput
from devrf.scenes.scene import Scene
from tiny_scenes import GivenScene

RATES = {"learning_rate": 1e-2, "final_learning_rate": 1e-3}


class Columns(StoredShape, ImageTrainable):
    """A picture whose colour is the sum of some rows of numbers; one is added in the middle."""

    name = "columns"
    resizable = {"rows": 1}

    def __init__(self) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.rand(2, 3))
        self.box, self.space, self.depth_limits = Box((-1.0,) * 3, (1.0,) * 3), WORLD, (0.1, 9.0)
        self.seen: list[ImageBatch] = []

    def config(self) -> dict[str, Any]:
        return {}

    def forward(self, batch: ImageBatch) -> RenderOutput:
        self.seen.append(batch)
        color = self.rows.sum(dim=0).expand(len(batch.color), 3)
        depth = torch.zeros_like(color[:, 0])
        return RenderOutput(color=color, depth=depth, transmittance=depth)

    def parts(self) -> dict[str, Iterable[nn.Parameter]]:
        return {"canonical": [self.rows]}

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "rows", "params": [self.rows], "rate": 3.0, "decay": 0.0}]

    def growths(self, total: int) -> list[int]:
        return [total // 2]

    def grow(self, count: int) -> Mapping[str, Tensor] | None:
        if count == 0 or len(self.rows) == 3:
            return None
        self.rows = nn.Parameter(torch.cat([self.rows.detach(), torch.ones(1, 3)]))
        return {"rows": torch.tensor([0, 1, -1])}

    def at(self, time: float) -> Columns:
        return self

    at_rest = True

    def image(self, camera: Any, background: Tensor, crop: Any) -> RenderedImage:
        pixels = camera.width * camera.height
        depth = torch.ones(pixels)
        return RenderedImage(self.rows.detach().sum(dim=0).expand(pixels, 3), depth, depth)


def image_stage(**settings: Any) -> ImageStage:
    """A stage of eight iterations."""
    step = settings.pop("step", ProtocolStage("joint", "both"))
    pixels = settings.pop("rays", 10_000)
    schedule = RaySchedule(iterations=8, rays=pixels, iterations_per_step=2, **RATES)
    return ImageStage(Columns(), schedule, {"render": 1.0}, step, **settings)


def test_a_batch_is_an_image_and_rows_that_stay_keep_their_moments(
    fit: Callable[..., ImageStage], tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("devrf.methods.image_stage.LEAST_SIDE", 9)
    stage = fit(image_stage(half_size=0.25, moving_share=0.6))
    seen = stage.scene_model.seen[:8]
    height, width = tiny_scene.static.train.pixels.shape[1:3]
    sizes = [(batch.camera.width, batch.camera.height) for batch in seen]
    assert sizes == [(width // 2, height // 2)] * 2 + [(width, height)] * 6
    assert stage.events[WHOLE] == 1 and stage.events["grids grown"] == 1
    static = len(tiny_scene.static.train)
    moving = tiny_scene.dynamic.train
    for batch in seen:
        if batch.image >= static:
            assert batch.time == float(moving.times[batch.image - static])
        else:
            assert batch.time == 0
    assert {batch.image >= static for batch in seen} == {False, True}
    (group,) = stage.optimizer.param_groups
    assert group["lr"] == group["base_lr"] == 3e-2  # its decay is 0
    state = stage.optimizer.state[stage.scene_model.rows]
    assert state["steps"] == 8 and state["mean"].shape == (3, 3)
    # The same slope for all: the first two rows have moments from before.
    assert not torch.equal(state["mean"][2], state["mean"][0])


def test_small_images_are_whole_from_the_first(
    fit: Callable[..., ImageStage], tiny_scene: Scene
) -> None:
    stage = fit(image_stage(half_size=0.5))
    height, width = tiny_scene.static.train.pixels.shape[1:3]
    seen = stage.scene_model.seen[:8]
    assert {(b.camera.width, b.camera.height) for b in seen} == {(width, height)}


def test_a_larger_image_is_drawn_in_part(fit: Callable[..., ImageStage], tiny_scene: Scene) -> None:
    height, width = tiny_scene.static.train.pixels.shape[1:3]
    stage = fit(image_stage(rays=5 * width + 1))
    seen = stage.scene_model.seen[:8]
    assert {batch.camera.height for batch in seen} == {5} and len(seen[0].color) == 5 * width
    middle = tiny_scene.static.train.cameras.center[0, 1]
    tops = {float(middle - batch.camera.center[0, 1]) for batch in seen}
    assert len(tops) > 1 and min(tops) >= 0 and max(tops) <= height - 5


def test_a_stopped_run_goes_on_to_the_same_rows(stopped_and_resumed: Callable[..., Any]) -> None:
    _, _, resumed = stopped_and_resumed(image_stage, at=6)
    assert len(resumed.scene_model.rows) == 3


def test_what_only_rays_have_is_refused() -> None:
    schedule = RaySchedule(iterations=8, rays=100, centre_crop=2, **RATES)
    protocol = Protocol("joint", {"joint": {"capture": "both"}})
    plan = ImagePlan(ImageStage, {"schedule": schedule, "model": Columns()}, protocol, "joint")
    with pytest.raises(DevrfError, match="centre_crop: expected 0, as the method learns"):
        plan.check()
    with pytest.raises(DevrfError, match=r"ray_stage.half_size: expected in \[0, 1\), not 1"):
        image_stage(half_size=1.0)


class ByAbsoluteError(Columns):
    """It learns by another term than ``render``, from valid pixels."""

    losses = ("l1",)

    def growths(self, total: int) -> list[int]:
        return []

    def loss_terms(self, output: RenderOutput, batch: ImageBatch, names: Any) -> dict[str, Tensor]:
        assert batch.valid is not None
        return {"l1": (output.color - batch.color)[batch.valid].abs().mean()}


def test_the_psnr_of_batches_is_that_of_valid_pixels(
    fit: Callable[..., ImageStage], tiny_scene: Scene
) -> None:
    train = tiny_scene.dynamic.train
    valid_mask = torch.zeros_like(train.pixels[..., 0], dtype=torch.bool)
    valid_mask[:, :, ::2] = True
    masked = replace(train, valid_mask=valid_mask)
    scene = replace(tiny_scene, dynamic=replace(tiny_scene.dynamic, train=masked))
    schedule = RaySchedule(iterations=1, rays=10_000, **RATES)
    step = ProtocolStage("dynamic", "dynamic")
    model = ByAbsoluteError()
    nn.init.zeros_(model.rows)
    stage = fit(ImageStage(model, schedule, {"l1": 1.0}, step), data=GivenScene(scene), every=1)
    (batch,) = model.seen[:1]
    shown = stage.trainer.callback_metrics["dynamic/render"]
    assert float(shown) == pytest.approx(float(batch.color[batch.valid].square().mean()))
    assert float(shown) != pytest.approx(float(batch.color.square().mean()), rel=1e-3)

"""Deformable Gaussians: what moves and when, views, checkpoints, resume, and that they learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.batch import ImageBatch
from devrf.data.datamodule import SceneDataModule
from devrf.engine.protocol import ProtocolStage
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.gaussians.cloud import Cloud
from devrf.methods.gaussians.model import USUAL_UNIT, DeformableGaussians
from devrf.methods.gaussians.settings import GaussiansSettings
from devrf.methods.image_stage import ImageStage
from devrf.methods.ray_schedule import RaySchedule
from devrf.rendering.renderer import Renderer, points_at_depth
from devrf.scenes.scene import Scene, Views

TINY = GaussiansSettings(
    start_points=150, hull_side=16, start_opacity=0.5, start_size=0.7, max_points=220, harmonics=1,
    harmonics_every=0.5, width=16, depth=2, embedding=3, bands=2, time_bands=2, still=0.0,
    means_rate=0.1,
    densify_from=0.25, densify_until=0.75, densify_every=0.25, densify_above=0.0, densify_share=0.2,
    split_above=0.0, prune_below=0.02, reset_every=0.0, all_decay=True,
)  # fmt: skip
STATIC = ProtocolStage("canonical", "static")
DEFORMATION = ProtocolStage("deformation", "dynamic", frozen=["canonical"], builds_on="canonical")
DYNAMIC = ProtocolStage("dynamic", "dynamic")
PARTS = ("means", "scales", "quaternions", "opacity", "color")  # whose rates a profile sets


def stage(
    step: ProtocolStage | None = None,
    rest: LoadedCheckpoint | None = None,
    settings: GaussiansSettings = TINY,
    iterations: int = 8,
) -> ImageStage:
    rates = {"learning_rate": 6e-3, "final_learning_rate": 6e-4, "betas": (0.9, 0.99), "eps": 1e-15}
    schedule = RaySchedule(iterations=iterations, rays=10_000, iterations_per_step=2, **rates)
    step = step or ProtocolStage("joint", "both")
    model = DeformableGaussians(settings)
    loss = {"l1": 1.0, "ssim": 0.2, "embedding": 0.1}
    return ImageStage(model, schedule, loss, step, earlier=rest, half_size=0.25)


def test_moves_are_as_large_as_the_scene_in_any_unit() -> None:
    model = DeformableGaussians(TINY)
    model.cloud.begin(torch.rand(9, 3), torch.rand(9, 3), torch.ones(9), 0.5)
    moved = []
    for factor in (1.0, 1024.0, 1 / 1024):
        with torch.no_grad():
            model.cloud.means *= factor
            box = Box((-2 * factor,) * 3, (2 * factor,) * 3)
            model.set_place(box, model.space, (0.1 * factor, 9 * factor))
            moves = model.moved(1.0)
            model.cloud.means /= factor
        assert moves is not None
        moved.append([moves[0] / factor, *moves[1:]])
    assert moved[0][0].abs().max() > 1e-4
    for others in moved[1:]:
        for move, other in zip(moved[0], others, strict=True):
            torch.testing.assert_close(other, move)


@pytest.mark.parametrize("first", [0.5, 0.03])
def test_nothing_moves_at_time_0_and_a_frame_later_all_does(first: float) -> None:
    model = DeformableGaussians(TINY)
    model.clock = type(model.clock)((0.0, first, 1.0))
    with torch.no_grad():
        model.last.bias.copy_(torch.arange(10.0))
    assert model.moved(0.0) is None
    full, half = model.moved(first), model.moved(first / 2)
    assert full is not None and half is not None
    expected = [[[0.0, 1 / USUAL_UNIT, 2 / USUAL_UNIT]], [[3.0, 4, 5, 6]], [[7.0, 8, 9]]]
    for move, begun, value in zip(full, half, expected, strict=True):
        torch.testing.assert_close(move, torch.tensor(value), atol=0.05, rtol=0)
        torch.testing.assert_close(begun, 0.5 * move, atol=0.05, rtol=0)


def test_without_static_images_the_cloud_moves_at_time_0_too(
    fit: Callable[..., ImageStage], stored: Callable[[ImageStage], LoadedCheckpoint]
) -> None:
    learned = fit(stage(DYNAMIC))
    model = learned.scene_model
    for shown in (model, stored(learned).model):
        at_first = shown.moved(0.0)
        assert at_first is not None and at_first[0].abs().max() > 0
    model.begin_stage(ProtocolStage("joint", "both"))
    assert model.moved(0.0) is None
    model.begin_stage(DEFORMATION)
    assert model.moved(0.0) is None


def test_a_view_is_the_splatted_cloud_before_its_background() -> None:
    model = DeformableGaussians(replace(TINY, harmonics=0))
    model.near = 1.0
    model.cloud.begin(
        torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]),
        torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]]),
        torch.tensor([1e-4, 1e-4]),
        0.8,
    )
    eye = torch.tensor([[0.0, -4.0, 0.0]])
    camera = Cameras.looking_at(eye, torch.zeros(1, 3), focal=20.0, width=9, height=5)
    model.focal = 20.0
    renderer = Renderer(model)
    image = renderer.view(camera, 0, 0.0, 0.5)
    pixel = image.color.view(5, 9, 3)
    # The first lies in the middle of the middle pixel, the second three pixels to the right.
    assert pixel[2, 4].tolist() == pytest.approx([0.8 + 0.1, 0.4 + 0.1, 0.1])
    assert pixel[2, 7].tolist() == pytest.approx([0.1, 0.1, 0.9])
    depth = image.depth.view(5, 9)
    assert depth[2, 4].item() == pytest.approx(4.0)
    assert depth[2, 7].item() == pytest.approx((16 + 0.36) ** 0.5)  # along the ray
    assert image.opacity.view(5, 9)[2, 4].item() == pytest.approx(0.8)
    cropped = renderer.view(camera, 0, 0.0, 0.5, Box((0.3, -1.0, -1.0), (1.0, 1.0, 1.0)))
    opacity = cropped.opacity.view(5, 9)
    assert opacity[2, 4] == 0 and opacity[2, 7].item() == pytest.approx(0.8)


@pytest.mark.parametrize("space", ["ndc", "contracted"])
def test_depths_and_crops_are_in_the_fields_space(
    tiny_toy: Scene, tiny_room: Scene, space: str
) -> None:
    scene = {"ndc": tiny_toy, "contracted": tiny_room}[space]
    model = DeformableGaussians(replace(TINY, harmonics=0))
    model.setup(scene)
    camera = scene.static.test.cameras.single(0)
    rays = camera.image_rays(0)
    number = camera.width * (camera.height // 2) + camera.width // 2
    point = rays.at(torch.tensor([number]), torch.tensor([3.0]))
    model.cloud.begin(point, torch.ones(1, 3), torch.tensor([1e-4]), 0.8)
    renderer = Renderer(model)
    image = renderer.view(camera, 0, 0.0, 0.0)
    assert image.opacity[number] > 0.5 and image.opacity[0] == 0 and image.depth[0] == 0
    found = points_at_depth(scene.space, rays, image.depth)[number]
    torch.testing.assert_close(found, point[0], atol=0.02, rtol=0)
    place = scene.space.from_world(point)[0]
    here = Box.of((place - 1e-3).tolist(), (place + 1e-3).tolist())
    for crop, seen in ((here, True), (here.moved((0.1, 0.0, 0.0)), False)):
        opacity = renderer.view(camera, 0, 0.0, 0.0, crop).opacity
        assert bool(opacity[number] > 0.5) == seen


def test_in_ndc_the_cloud_begins_before_the_cameras_with_masks_too(tiny_toy: Scene) -> None:
    masked = replace(tiny_toy.static, train=_with_masks(tiny_toy.static.train))
    model = DeformableGaussians(TINY)
    model.setup(replace(tiny_toy, static=masked))
    assert (model.cloud.means[:, 2] < -0.9 * tiny_toy.space.near).all()


def _with_masks(views: Views) -> Views:
    """The views with an alpha channel that is 0 in a corner."""
    alpha = torch.full_like(views.pixels[..., :1], 255)
    alpha[:, :2, :2] = 0
    return replace(views, pixels=torch.cat([views.pixels[..., :3], alpha], dim=-1))


def test_pictures_begin_where_cameras_saw_what_was_learned() -> None:
    model = DeformableGaussians(replace(TINY, harmonics=0))
    model.near = 1.0
    places = torch.tensor([[0.0, -3.1, 0.0], [0.0, -2.9, 0.0]])
    camera = Cameras.looking_at(
        torch.tensor([[0.0, -4.0, 0.0]]), torch.zeros(1, 3), focal=20.0, width=9, height=5
    )
    for place, seen in zip(places, (0.0, 0.8), strict=True):
        model.cloud.begin(place[None], torch.ones(1, 3), torch.tensor([1e-4]), 0.8)
        opacity = Renderer(model).view(camera, 0, 0.0, 0.0).opacity.view(5, 9)
        assert opacity[2, 4].item() == pytest.approx(seen)


def test_a_longer_lens_shows_gaussians_as_wide() -> None:
    model = DeformableGaussians(replace(TINY, harmonics=0))
    model.cloud.begin(torch.zeros(1, 3), torch.ones(1, 3), torch.tensor([1e-4]), 0.8)
    model.focal = 20.0
    eye = torch.tensor([[0.0, -4.0, 0.0]])
    camera = Cameras.looking_at(eye, torch.zeros(1, 3), focal=20.0, width=9, height=9)
    near = Renderer(model).view(camera, 0, 0.0, 0.0).opacity.view(9, 9)
    large = Renderer(model).view(camera.resized(27, 27), 0, 0.0, 0.0).opacity.view(27, 27)
    torch.testing.assert_close(large[1::3, 1::3], near, atol=1e-3, rtol=0)


def test_a_stopped_run_goes_on_to_the_same_cloud(stopped_and_resumed: Callable[..., Any]) -> None:
    whole, stopped, resumed = stopped_and_resumed(stage, at=6)
    cloud = resumed.scene_model.cloud
    assert len(cloud) == len(whole.scene_model.cloud) > 150
    assert int(cloud.grown) == 3 and resumed.scene_model.degree == 1
    state = resumed.optimizer.state[cloud.means]
    assert state["mean"].shape == cloud.means.shape


@pytest.mark.parametrize("scored", [False, True])
def test_the_same_stage_goes_on_exactly_scored_or_not(
    fit: Callable[..., ImageStage],
    same_weights: Callable[..., None],
    datamodule: SceneDataModule,
    trainer: Callable[..., Trainer],
    tmp_path: Path,
    scored: bool,
) -> None:
    torch.manual_seed(0)
    whole = fit(stage())
    torch.manual_seed(0)
    first, left = trainer(max_steps=4), stage()  # two of its own
    first.fit(left, datamodule=datamodule)
    if scored:
        first.test(left, datamodule=datamodule, verbose=False)
    first.save_checkpoint(tmp_path / "left.ckpt")
    fit(left, ckpt_path=tmp_path / "left.ckpt")
    assert left.background.name == whole.background.name == "random"
    same_weights(whole, left)


def test_a_checkpoint_shows_what_was_learned(
    fit: Callable[..., ImageStage],
    stored: Callable[[ImageStage], LoadedCheckpoint],
    tiny_scene: Scene,
) -> None:
    learned = fit(stage())
    model = stored(learned).model
    cameras = tiny_scene.dynamic.test.cameras
    for time in (0.0, 0.7):
        ours, theirs = (
            Renderer(m).view(cameras, 0, time, 1.0) for m in (learned.scene_model, model)
        )
        assert torch.equal(ours.color, theirs.color) and torch.equal(ours.depth, theirs.depth)
    assert model.at(0.0).at_rest and not model.at(1.0).at_rest


def test_in_two_stages_the_cloud_stays_while_motion_is_learned(
    fit: Callable[..., ImageStage],
) -> None:
    first = fit(stage(STATIC))
    cloud = first.scene_model.cloud
    assert len(cloud) > 150 and first.events["grids grown"] == 3
    before = {name: getattr(cloud, name).detach().clone() for name in Cloud.at_rest}
    assert not cloud.embedding.any()
    second = fit(stage(DEFORMATION, first.result()))
    model = second.scene_model
    groups = [group["name"] for group in second.optimizer.param_groups]
    assert groups == ["deformation", "embedding"] and model.cloud.embedding.any()
    assert all(torch.equal(getattr(model.cloud, name), value) for name, value in before.items())
    assert model.last.bias.any() and second.events["grids grown"] == 0 and model.degree == 1


def test_two_gaussians_at_one_place_move_apart_by_their_embeddings() -> None:
    model = DeformableGaussians(TINY)
    model.cloud.begin(torch.zeros(2, 3), torch.zeros(2, 3), torch.ones(2), 0.5)
    batch = SimpleNamespace(color=torch.zeros(1, 3), valid=None)
    output = SimpleNamespace(color=torch.zeros(1, 3))

    def moves_and_term() -> tuple[Tensor, float]:
        moves = model.moved(1.0)
        assert moves is not None
        term = model.loss_terms(output, batch, ["embedding"])["embedding"]
        return moves[0], float(term.detach())

    moves, term = moves_and_term()
    torch.testing.assert_close(moves[0], moves[1])
    assert term == 0
    with torch.no_grad():
        model.cloud.embedding[1] = torch.tensor([1.0, 2.0, -2.0])
    moves, term = moves_and_term()
    assert not torch.allclose(moves[0], moves[1])
    assert term == 9  # each is the other's neighbour


def test_the_loss_falls(fit: Callable[..., ImageStage]) -> None:
    errors = []

    for iterations in (2, 40):
        learned = fit(stage(iterations=iterations))
        views = learned.datamodule.training_views("dynamic", learned.device)
        image = Renderer(learned.scene_model).view(views.cameras, 0, float(views.times[0]), 1.0)
        alpha = views.pixels[0].float().flatten(0, 1)[:, 3:] / 255
        truth = 1 + alpha * (views.pixels[0].float().flatten(0, 1)[:, :3] / 255 - 1)
        errors.append(float((image.color - truth).abs().mean()))
    assert errors[1] < 0.6 * errors[0]


def test_pixels_that_are_not_valid_do_not_count(fit: Callable[..., ImageStage]) -> None:
    model = fit(stage(iterations=2)).scene_model
    camera = Cameras.looking_at(
        torch.tensor([[4.0, 0.0, 0.5]]), torch.zeros(1, 3), focal=20.0, width=12, height=12
    )
    batch = ImageBatch(
        camera, torch.ones(144, 3), None, torch.zeros(144, dtype=torch.bool), torch.zeros(3), 1.0, 0
    )
    terms = model.loss_terms(model(batch), batch, ("l1", "ssim"))
    assert terms["l1"] == 0 and terms["ssim"].item() == pytest.approx(0, abs=1e-5)
    seen = model.loss_terms(model(batch), replace(batch, valid=None), ("l1",))
    assert set(seen) == {"l1"} and seen["l1"] > 0


def test_memory_is_that_of_as_many_as_there_may_be() -> None:
    model = DeformableGaussians(replace(TINY, max_points=1001))
    network = sum(p.numel() for p in (*model.trunk.parameters(), *model.last.parameters()))
    # 3 + 3 + 4 + 1 + 3 numbers, and the colours of four harmonics; and the one that is there.
    assert model.most_bytes == 4 * (network + 1002 * (14 + 3 * 4))


@pytest.mark.parametrize("space", ["ndc", "contracted"])
def test_unbounded_scenes_are_learned_in_the_world(
    fit: Callable[..., ImageStage],
    serve: Callable[[Scene], SceneDataModule],
    stored: Callable[[ImageStage], LoadedCheckpoint],
    tiny_toy: Scene,
    tiny_room: Scene,
    space: str,
) -> None:
    scene = {"ndc": tiny_toy, "contracted": tiny_room}[space]
    bare = DeformableGaussians(TINY)
    bare.setup(scene)
    # They begin as densely as samples lie, but for where infinity is.
    places = scene.space.from_world(bare.cloud.means)
    half, whole = scene.bounds.whole.scaled(0.45), scene.bounds.whole.scaled(0.901)
    assert whole.contains(places).all()
    assert half.contains(places).float().mean().item() == pytest.approx(1 / 8, abs=0.08)
    learned = fit(stage(iterations=240), data=serve(scene))
    views = scene.dynamic.train
    time, truth = float(views.times[-1]), views.pixels[-1, ..., :3].float().view(-1, 3) / 255

    def error(model: DeformableGaussians) -> float:
        picture = Renderer(model).view(views.cameras, len(views) - 1, time, 1.0).color
        return (picture - truth).abs().mean().item()

    assert error(learned.scene_model) < 0.75 * error(bare)
    model = stored(learned).model
    with torch.no_grad():
        model.cloud.means[0] = 0.0  # where NDC has no place
        assert all(move.isfinite().all() for move in model.moved(1.0))
    ours, theirs = (
        Renderer(m).view(scene.dynamic.test.cameras, 0, 0.7, 1.0)
        for m in (learned.scene_model, stored(learned).model)
    )
    assert torch.equal(ours.color, theirs.color)
    assert model.space == scene.space and model.box == scene.bounds.whole


def test_what_moves_is_apart_from_what_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    model = DeformableGaussians(TINY)
    model.clock = type(model.clock)((0.0, 0.5, 1.0))
    places = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]])
    model.cloud.begin(places, torch.rand(3, 3), torch.full((3,), 0.1), 0.5)
    # Halfway the second is a tenth of the radius farther along z, the third a 25th.
    along_z = torch.tensor([[0.0, 0, 0.1], [0.0, 0, 0.04], [0.0, 0, 0]])

    def moved(self: DeformableGaussians, time: float) -> Any:
        return (time == 0.5) * self.cloud.means @ along_z, torch.zeros(1, 4), torch.zeros(1, 3)

    monkeypatch.setattr(DeformableGaussians, "moved", moved)
    parts = model.moving_and_still(1.0)
    assert isinstance(parts["moving"], DeformableGaussians)
    assert torch.equal(parts["moving"].cloud.means, places[1:2])
    assert torch.equal(parts["still"].cloud.means, places[[0, 2]])
    assert parts["still"].trunk is model.trunk and len(model.cloud) == 3
    gone = parts["moving"].gaussians_at(0.5).means
    torch.testing.assert_close(gone, torch.tensor([[1.0, 0, 0.1]]))
    assert not model.moving_and_still(10.0)  # where a tenth is little
    model.cloud.keep(torch.tensor([False, True, False]))
    assert not model.moving_and_still(1.0)  # nothing stays


def test_for_one_camera_the_network_alone_learns_more_slowly(composed: Callable[..., Any]) -> None:
    rates = {}
    for profile in ("gaussians_small", "gaussians_phone_small"):
        stage = composed("method=gaussians", f"profile={profile}").ray_stage
        network, settings = stage.schedule.learning_rate, stage.model.settings
        own = (network * settings[f"{part}_rate"] for part in PARTS)
        fall = stage.schedule.final_learning_rate / network
        rates[profile] = (network, fall, *own)
    usual, phone = rates.values()
    assert phone[0] == pytest.approx(usual[0] / 3)
    assert phone[1:] == pytest.approx(usual[1:], rel=0.03)

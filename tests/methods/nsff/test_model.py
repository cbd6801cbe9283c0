"""NSFF learns from all of its terms, on scenes of every space."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.errors import DevrfError
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.settings import NSFFSettings, Warmup
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Capture, Scene

Make = Callable[..., RayStage]
Fit = Callable[..., RayStage]
EVERY = dict.fromkeys(NSFF.losses, 0.1)


@pytest.mark.parametrize(("sampling", "blend"), [("occupancy", "v"), ("stratified", "additive")])
def test_it_learns(
    sampling: Any, blend: Any, tiny: NSFFSettings, learned_losses: Callable[..., list[float]]
) -> None:
    model = NSFF(replace(tiny, sampling=sampling, blend=blend, hard_rays=0))
    loss, sizes = {"render": 1.0, "neighbours": 0.1}, {"iterations": 45, "iterations_per_step": 15}
    colors = learned_losses(model, "render", loss=loss, rays=64, **sizes)
    assert len(colors) == 3 and colors[-1] < 0.8 * colors[0]


def test_every_term_is_learned_from_and_finite(
    tiny: NSFFSettings, ray_stage: Make, fit: Fit, four_frames: SceneDataModule
) -> None:
    stage = fit(ray_stage(NSFF(tiny), loss=EVERY), data=four_frames)
    metrics = stage.trainer.callback_metrics
    for name in NSFF.losses:
        assert math.isfinite(metrics[f"both/{name}"]), name
    assert metrics["both/chained"] > 0
    # Whatever has had a gradient has moments.
    assert all(stage.optimizer.state.get(p) for p in stage.scene_model.parameters())


def test_batches_have_further_rays_where_something_moves(
    tiny: NSFFSettings, ray_stage: Make, fit: Fit, tiny_scene: Scene
) -> None:
    stage = fit(ray_stage(NSFF(tiny), loss=EVERY))
    sizes = []
    for step in (0, 1, 2):  # N₀ = 2
        stage.scene_model.on_iteration(step, 4)
        # Images are numbered through both captures.
        image = stage.draw()[0]
        sizes.append(len(image))
        assert int((image < len(tiny_scene.static.train)).sum()) == 16
    assert sizes == [36, 36, 32]


@pytest.mark.parametrize(
    ("where", "sampling"),
    [("forward", "stratified"), ("room", "occupancy")],
)
def test_a_scene_of_any_space_is_learned_and_comes_back(
    where: str, sampling: Any, tiny: NSFFSettings, ray_stage: Make, fit: Fit,
    stored: Callable[[RayStage], LoadedCheckpoint], serve: Callable[[Scene], SceneDataModule],
    facing: Scene, tiny_room: Scene,
) -> None:  # fmt: skip
    scene = {"forward": facing, "room": tiny_room}[where]
    model = NSFF(replace(tiny, sampling=sampling))
    loaded = stored(fit(ray_stage(model, loss=EVERY), data=serve(scene))).model
    assert isinstance(loaded, NSFF) and loaded.settings == model.settings
    assert loaded.fields.dynamic.reach == (1.0 if where == "forward" else 0.2)
    cameras = scene.dynamic.test.cameras
    # 0.7 lies between frames.
    images = [Renderer(m).view(cameras, 1, 0.7, 1.0) for m in (model, loaded)]
    assert torch.equal(images[0].color, images[1].color)
    # The last sample stands for all that is behind it: no background shows.
    torch.testing.assert_close(images[1].opacity, torch.ones_like(images[1].opacity))


def test_it_is_shown_without_the_noise_that_it_learns_with(
    tiny: NSFFSettings, tiny_scene: Scene
) -> None:
    settings = replace(tiny, density_noise=1.0)
    torch.manual_seed(0)
    model = NSFF(settings)
    model.setup(tiny_scene)
    exact = NSFF(replace(settings, density_noise=0.0))
    exact.setup(tiny_scene)
    exact.load_state_dict(model.state_dict())
    cameras = tiny_scene.dynamic.test.cameras
    # While it is learned, too: the viewer and previews show it then.
    assert model.training
    images = [Renderer(one).view(cameras, 0, 0.5, 1.0) for one in (model, exact)]
    assert torch.equal(images[0].color, images[1].color)


def test_a_scene_that_says_nothing_has_nothing_to_learn(
    tiny: NSFFSettings, ray_stage: Make, fit: Fit, serve: Callable[[Scene], SceneDataModule],
    tiny_scene: Scene,
) -> None:  # fmt: skip
    train = replace(tiny_scene.dynamic.train, flow=None)
    mute = replace(tiny_scene, dynamic=Capture(train, tiny_scene.dynamic.test))
    with pytest.raises(DevrfError, match="ray_stage.loss"):
        fit(ray_stage(NSFF(tiny), "dynamic", loss={"flow": 1.0}), data=serve(mute))


@pytest.mark.parametrize(("frames", "steps"), [(12, 30_000), (50, 50_000), (400, 250_000)])
def test_the_beginning_grows_with_the_frames_within_limits(frames: int, steps: int) -> None:
    assert Warmup().steps(frames) == steps


def test_priors_fall_tenfold_after_each_beginning() -> None:
    warmup = Warmup(steps_per_frame=10, min_frames=1)
    factors = [warmup.prior_factor(step, frames=5) for step in (0, 49, 50, 99, 100)]
    assert factors == pytest.approx([1, 1, 0.1, 0.1, 0.01])


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: NSFFSettings(width=1), r"settings\.width: expected at least 2, not 1;"),
        (lambda: NSFFSettings(flow_reach=0.0), r"settings\.flow_reach"),
        (lambda: Warmup(min_frames=300), r"settings\.warmup\.min_frames: .*250"),
    ],
)
def test_what_cannot_be_is_named(make: Any, key: str) -> None:
    with pytest.raises(DevrfError, match=key):
        make()

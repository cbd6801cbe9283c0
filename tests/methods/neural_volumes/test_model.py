"""Neural Volumes learns, shows frames without their images, and says what it cannot learn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from devrf.checkpoints.checkpoint import LoadedCheckpoint
from devrf.errors import DevrfError
from devrf.methods.neural_volumes.model import NeuralVolumes
from devrf.methods.neural_volumes.settings import NeuralVolumesSettings
from devrf.methods.ray_stage import RayStage
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Capture, Scene

TINY = NeuralVolumesSettings(
    code=4, encoder_views=2, encoder_size=(16, 16), encoder_channels=(4, 4, 4), encoder_width=8,
    template_channels=(8, 8, 8), warp_side=4, warp_channels=(4, 4), density_scale=10.0, step=0.2,
    hull=True, occupancy_side=8,
)  # fmt: skip
LOSS = {"render": 1.0, "kl": 1e-5, "opacity_prior": 1e-4, "tv": 1e-4}


@pytest.mark.parametrize(("warp", "hull"), [("conv", False), ("affinemix", True)])
def test_it_learns(warp: Any, hull: bool, learned_losses: Callable[..., list[float]]) -> None:
    model = NeuralVolumes(replace(TINY, warp=warp, maps=2, hull=hull))
    sizes = {"iterations": 60, "rays": 128, "iterations_per_step": 20, "times_per_batch": 2}
    losses = learned_losses(model, loss=LOSS, learning_rate=3e-3, **sizes)
    assert len(losses) == 3 and losses[-1] < 0.8 * losses[0]


def test_a_frame_looks_the_same_by_its_images_and_by_its_stored_code(
    ray_stage: Callable[..., RayStage], fit: Callable[..., RayStage],
    stored: Callable[[RayStage], LoadedCheckpoint], tiny_scene: Scene,
) -> None:  # fmt: skip
    model = NeuralVolumes(TINY)
    loaded = stored(fit(ray_stage(model, loss=LOSS))).model
    assert len(model.images) == 3 and len(loaded.images) == 0
    cameras = tiny_scene.dynamic.test.cameras
    for time in (0.0, 0.5, 0.7, 1.0):
        images = [Renderer(m).view(cameras, 1, time, 1.0) for m in (model, loaded)]
        torch.testing.assert_close(images[0].color, images[1].color, atol=1e-6, rtol=0)
        assert Renderer(loaded).at(time).at_rest == (time == 0.0)


def test_codes_between_two_frames_are_their_blend(tiny_scene: Scene) -> None:
    model = NeuralVolumes(TINY)
    model.setup(tiny_scene)
    first, second = (model.code_at(time) for time in (0.0, 0.5))
    assert not torch.equal(first, second)
    torch.testing.assert_close(model.code_at(0.125), 0.75 * first + 0.25 * second)


def test_what_it_cannot_learn_from_is_refused(
    tiny_room: Scene, tiny_scene: Scene, facing: Scene
) -> None:
    both = tiny_scene.static.train, tiny_scene.static.test
    static = Capture(*(replace(views, pixels=views.pixels[..., :3]) for views in both))
    for scene, said in (
        (tiny_room, "unbounded"),
        (replace(tiny_scene, static=static), "static images of robot have no alpha masks"),
        (facing, "seen from one side"),
    ):
        with pytest.raises(DevrfError, match=said):
            NeuralVolumes(TINY).setup(scene)
    with pytest.raises(DevrfError, match=r"settings\.encoder_views: .*2, as robot"):
        NeuralVolumes(replace(TINY, encoder_views=3)).setup(tiny_scene)
